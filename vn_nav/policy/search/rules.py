"""Numbers of the decisions of a search, and what may be taken away from it."""

from __future__ import annotations

import dataclasses


@dataclasses.dataclass(frozen=True)
class Rules:
    """Numbers of the decisions, fitted on training houses."""

    follow_from: float = 2.0  # evidence of a hypothesis that the robot drives to
    near_m: float = 1.2  # so near a hypothesis place and heading are planned together
    near_worth: float = 0.3  # probability, less the price of the way, that makes it worth it
    decision_price: float = 0.03  # as a probability of having arrived
    looks_in_doubt: float = 2  # where the robot stands on a hypothesis, and has not arrived
    turn_cost: float = 0.05  # m that a turn is worth
    look_cost: float = 0.12  # m that a turn to look is worth
    look_worth: float = 0.6  # m that a square metre of unknown floor in view is worth
    look_most: float = 1.5  # m
    look_from: float = 0.4  # m^2 in view that make a look
    contact_cost: float = 4.0  # for each metre that an obstacle would cut off
    graze_cost: float = 0.6  # m for passing an obstacle at the footprint, none from `graze_m` on
    graze_m: float = 0.2
    backward_cost: float = 0.3  # m
    back_cost: float = 0.3  # m for turning back where the robot has just turned from
    return_margin: float = 1.5  # decisions left, over those to its best guess: it turns back
    # What `bench/search.py` takes away, to measure what it adds.
    gathers: bool = True  # evidence over looks; else the newest vote alone counts
    refutes: bool = True  # hypotheses lose evidence where the goal is not recognised
    registers: bool = True  # the goal picture's ranges say where on the map it fits
    unsticks: bool = True  # a robot that is stuck passes obstacles closer
    returns: bool = True  # back to the best guess in time, where the budget is known
