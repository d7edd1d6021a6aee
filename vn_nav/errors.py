"""The one error type that a user sees as a single line."""


class UserError(Exception):
    """Bad input from the user: states the rule, the value received and the remedy.

    Commands and nodes print it as one line on standard error and exit with code 2.
    """

    def __init__(self, rule: str, received: object, remedy: str):
        self.rule, self.received, self.remedy = rule, received, remedy
        super().__init__(f'{rule}; received {received!r}; {remedy}')


class EnvironmentLost(UserError):
    """An environment that cannot go on, such as a robot whose camera is gone.

    What was learned until then is whole, and worth keeping.
    """
