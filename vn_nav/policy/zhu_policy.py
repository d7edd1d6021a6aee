"""The policy of icra2017: frozen features, nothing recurrent, layers of its own for each scene.

Its parts are in `vn_nav.policy.zhu`.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from vn_nav.errors import UserError
from vn_nav.observation import Observation
from vn_nav.policy.memory import RecurrentState
from vn_nav.policy.network import Latents, Policy, PolicyOutput
from vn_nav.policy.network_config import SEARCH, NetworkConfig
from vn_nav.policy.search.network import SearchPolicy
from vn_nav.policy.zhu import SceneLinear, Siamese


def build_policy(config: NetworkConfig) -> Policy:
    """The network of a configuration, whatever its architecture, with random weights."""
    kinds: dict[str, type[Policy]] = {'icra2017': ScenePolicy, SEARCH: SearchPolicy}
    return kinds.get(config.architecture, Policy)(config)


class ScenePolicy(Policy):
    """The network of Zhu et al., see `vn_nav.policy.zhu`."""

    frozen = True
    encoder: Siamese

    def _build(self, config: NetworkConfig) -> None:
        width = config.hidden
        self.places = self.tracker = self.around = None
        self.encoder = Siamese(config.frozen, config.frames, width)
        self.memory = SceneLinear(width, width, config.scenes)
        self.actor = SceneLinear(width, len(config.actions), config.scenes)
        self.critic = SceneLinear(width, 1, config.scenes)
        self.heads = nn.ModuleDict()
        self.target_side = self.cell = 0

    def look(self, pictures: Tensor) -> Tensor:
        """Frozen features [...,F] of pictures [...,3,S,S], to pass in place of them.

        Goals take them in `Observation.goals`, pictures in `Observation.extras['features']`: what
        never changes is then computed once.
        """
        return self.encoder.look(pictures)

    def encode_goals(self, goals: Tensor) -> Tensor:
        """What the encoder keeps of goals [G,3,S,S] uint8, or of their features [G,F]."""
        return self.encoder.encode_goals(goals, self.compute_dtype)

    def read(self, latents: Latents) -> PolicyOutput:
        """Actor and critic of each row's scene."""
        return PolicyOutput(self.actor(latents.hidden, latents.scene),
                            self.critic(latents.hidden, latents.scene).squeeze(-1))

    def _frames_before(self, batch: int) -> Tensor:
        return torch.zeros(batch, self.config.frames - 1, self.encoder.frozen.features,
                           device=self.device)

    def takes_features(self, size: int) -> bool:
        """Whether features of this size [F] can stand for pictures."""
        return size == self.encoder.frozen.features

    def _frames(self, obs: Observation) -> Tensor:
        known = (obs.extras or {}).get('features')
        return self.look(obs.image) if known is None else known

    def _remember(self, obs: Observation, starts: Tensor, state: RecurrentState, maps: Tensor,
                  features: Tensor, goal_places: Tensor | None
                  ) -> tuple[Latents, RecurrentState]:
        scene = self._scene(obs)
        own = self.memory(features.view(*starts.shape, -1), scene)
        return Latents(maps, features, torch.relu(own).float(), None, scene), state

    def _scene(self, obs: Observation) -> Tensor:
        """[T,B] whose layers see the observations."""
        if self.config.scenes == 1:
            return torch.zeros_like(obs.last_action)
        extras = obs.extras or {}
        if 'scene' not in extras:
            raise UserError('a network with layers for several scenes needs the scene',
                            "observations without extras['scene']", 'pass it, or train and use '
                            'a network of one scene')
        return extras['scene']
