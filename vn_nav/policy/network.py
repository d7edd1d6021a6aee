"""The goal-conditioned policy: an encoder of picture and goal, a memory, actor, critic and heads.

Shapes are time-major: T steps, B environments, A actions, G distinct goals, H hidden units, S side
of the square pictures [pixels], F features.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from vn_nav.errors import UserError
from vn_nav.observation import Observation
from vn_nav.policy.encoders import Encoder
from vn_nav.policy.heads import Pose, grown
from vn_nav.policy.memory import Feedforward, GoalTracker, MaskedLSTM, RecurrentState, stack_frames
from vn_nav.policy.network_config import SEARCH, NetworkConfig
from vn_nav.policy.network_parts import PUBLISHED, build_encoder, build_head, initialise
from vn_nav.policy.places import PLACE_FEATURES, MultiViewAveraging, PathAdvice, PlaceClassifier
from vn_nav.policy.zhu import SceneLinear, Siamese

# Pictures go through the encoder in parts of this size on a processor: larger float32 pixels are
# mapped and unmapped by the allocator at every call, which costs a tenth of the whole training.
CHUNK_BYTES = 2**24


class PolicyOutput(NamedTuple):
    """Outputs of the network; float32."""

    logits: Tensor  # [T,B,A] unnormalised log-probabilities
    value: Tensor  # [T,B] of the state
    arrival: Tensor | None = None  # [T,B] logit: the robot stands where the goal was taken


class Latents(NamedTuple):
    """What the heads read."""

    maps: Tensor  # [T*B,C,h,w] the encoder's last maps
    features: Tensor  # [T*B,F]
    hidden: Tensor  # [T,B,H] float32 outputs of the memory
    pose: Pose | None  # [T*B,...], if the network has the head goal_pose
    scene: Tensor | None = None  # [T,B] int64, of icra2017
    advice: Tensor | None = None  # [T,B,A] logits, of a policy that knows the place


class Policy(nn.Module):
    """An encoder, a memory, actor and critic (thesis, figure 4.1), and heads.

    One of icra2017 is a `vn_nav.policy.zhu_policy.ScenePolicy`, one of search a
    `vn_nav.policy.search.network.SearchPolicy`; `zhu_policy.build_policy` makes any.

    Attributes:
        frozen: whether pictures pass an encoder that learns nothing before anything else.
        uses_odometry: whether it takes what the robot's odometry says of its motion; a figure of
            such a policy says which odometry that was.
        compute_dtype: type of the convolutions and matrix products; parameters, memory and
            outputs are float32 in any case.
        heads: the auxiliary heads by name.
        target_side: side of the maps that pixel control and image heads draw.
        cell: pixels of the picture under one cell of these maps; both 0 where there are none.
    """

    frozen = False
    uses_odometry = False
    encoder: Encoder | Siamese
    memory: Feedforward | MaskedLSTM | SceneLinear
    actor: nn.Linear | SceneLinear
    critic: nn.Linear | SceneLinear
    tracker: GoalTracker | None
    places: PlaceClassifier | None
    routes: PathAdvice | None
    around: MultiViewAveraging | None

    def __init__(self, config: NetworkConfig):
        super().__init__()
        self.config = config
        self.compute_dtype = torch.float32
        self._build(config)

    def _build(self, config: NetworkConfig) -> None:
        """The parts."""
        if config.architecture in ('icra2017', SEARCH):
            raise UserError('a policy of icra2017 or search is made by zhu_policy.build_policy',
                            config.architecture, 'call that')
        thesis = config.architecture in PUBLISHED
        self.encoder = encoder = build_encoder(config)
        inputs = (encoder.features + len(config.actions) + 1
                  + (5 if config.pose_to_memory else 0)
                  + (GoalTracker.WIDTH if config.moves else 0)
                  + (PLACE_FEATURES if config.places else 0))
        self.tracker = GoalTracker(config.moves) if config.moves else None
        if config.frames > 1:
            self.memory = Feedforward(inputs, config.hidden)
        else:
            self.memory = MaskedLSTM(inputs, config.hidden, thesis=thesis)
        self.places = self.routes = self.around = None
        if config.places:
            if config.moves:
                self.around = MultiViewAveraging(config.moves, config.places)
            self.places = PlaceClassifier(config.size, config.places, config.pixel_mean,
                                          config.pixel_std)
            self.routes = PathAdvice(self.places.width, len(config.actions))
            with torch.no_grad():
                self._goal_shape = encoder.encode_goals(
                    torch.zeros(1, 3, config.size, config.size, dtype=torch.uint8),
                    torch.float32).shape[1:]
        self.actor = actor = nn.Linear(config.hidden, len(config.actions))
        self.critic = critic = nn.Linear(config.hidden, 1)
        for layer, gain in ((actor, 0.01), (critic, 1.0)):
            initialise(layer, gain, thesis)
        channels, side = encoder.maps
        self.target_side = grown(side, config.deconvolutions)
        self.cell = max(config.size // self.target_side, 1)
        self.heads = nn.ModuleDict({
            name: build_head(name, config, channels, side, encoder.features)
            for name in config.heads})

    def initial_state(self, batch: int) -> RecurrentState:
        """An empty memory."""
        config = self.config
        if config.frames > 1:
            return RecurrentState(self._frames_before(batch),
                                  torch.zeros(batch, 0, device=self.device))
        zeros = torch.zeros(batch, config.hidden, device=self.device)
        carried = torch.zeros(batch, sum(self._carried), device=self.device)
        return RecurrentState(torch.cat([zeros, carried], dim=1), zeros.clone())

    def _frames_before(self, batch: int) -> Tensor:
        """What stands for the frames before an episode, [batch,frames-1,...]."""
        config = self.config
        return torch.zeros(batch, config.frames - 1, 3, config.size, config.size,
                           dtype=torch.uint8, device=self.device)

    @property
    def _carried(self) -> tuple[int, int]:
        """Numbers carried along with the memory's: by tracker, by multi-view averaging."""
        return (0 if self.tracker is None else GoalTracker.WIDTH,
                0 if self.around is None else self.around.width)

    @property
    def device(self) -> torch.device:
        """Where the parameters are."""
        return next(self.parameters()).device

    def encode_goals(self, goals: Tensor) -> Tensor:
        """What the encoder keeps of goals [G,3,S,S] uint8; see `vn_nav.policy.encoders`.

        A policy that knows a place keeps [G,...+K+16]: where they were taken, behind the rest.
        """
        if self.config.frames > 1:
            goals = goals.repeat(1, self.config.frames, 1, 1)
        maps = self.encoder.encode_goals(goals, self.compute_dtype)
        if self.places is None:
            return maps
        return torch.cat([maps.flatten(1), self.places(goals, self.compute_dtype).to(maps.dtype)],
                         dim=1)

    def encode(self, image: Tensor, goal_maps: Tensor, goal_index: Tensor | None
               ) -> tuple[Tensor, Tensor]:
        """Maps [N,C,h,w] and features [N,F] of pictures [N,3*frames,S,S] uint8.

        Without an index goal n belongs to picture n.
        """
        count = len(image)
        if self.compute_dtype == torch.float32 and image.device.type == 'cpu':
            count = max(CHUNK_BYTES // (4 * image[0].numel()), 1)
        parts = [slice(first, first + count) for first in range(0, len(image), count)]
        if len(parts) == 1:
            return self.encoder(image, goal_maps, goal_index, self.compute_dtype)
        done = [self.encoder(image[part], goal_maps if goal_index is not None else goal_maps[part],
                             None if goal_index is None else goal_index[part],
                             self.compute_dtype) for part in parts]
        maps, features = zip(*done, strict=True)
        return torch.cat(maps), torch.cat(features)

    def latents(self, obs: Observation, starts: Tensor, state: RecurrentState | None = None,
                goal_maps: Tensor | None = None) -> tuple[Latents, RecurrentState]:
        """What actor, critic and heads read, for T steps of B environments; see `forward`."""
        steps, batch = starts.shape
        if state is None:
            state = self.initial_state(batch)
            if self.config.frames > 1:  # no pictures before: the first one stands for them
                starts = starts.clone()
                starts[0] = True
        if goal_maps is None:
            goal_maps = self.encode_goals(obs.goals)
        goal_maps, goal_places = self.goal_parts(goal_maps)
        maps, features, state = self._look(obs, starts, state, goal_maps)
        return self._remember(obs, starts, state, maps, features, goal_places)

    def _remember(self, obs: Observation, starts: Tensor, state: RecurrentState, maps: Tensor,
                  features: Tensor, goal_places: Tensor | None
                  ) -> tuple[Latents, RecurrentState]:
        """From what is seen to what the heads read, by way of the memory."""
        steps, batch = starts.shape
        # One-hot of the last action; all zeros (not a class) for -1, an episode's start.
        actions = torch.arange(len(self.config.actions), device=features.device)
        dtype = features.dtype
        inputs = [features.view(steps, batch, -1),
                  (obs.last_action.unsqueeze(-1) == actions).to(dtype),
                  obs.last_reward.clamp(-1.0, 1.0).unsqueeze(-1).to(dtype)]
        pose = advice = None
        if 'goal_pose' in self.heads:
            pose = self.heads['goal_pose'](features)
            if self.config.pose_to_memory:
                inputs.append(_compass(pose).view(steps, batch, -1).to(dtype))
        own = state
        carried: list[Tensor] = []
        if any(self._carried):
            hidden, tracked, looked = state.hidden.split((self.config.hidden, *self._carried), 1)
            own = RecurrentState(hidden, state.cell)
        if self.tracker is not None:
            assert pose is not None  # moves are given with pose_to_memory alone
            seen, tracked = self.tracker(
                *(part.detach().view(steps, batch, *part.shape[1:]) for part in pose),
                obs.last_action, starts, tracked)
            inputs.append(seen.to(dtype))
            carried.append(tracked)
        if self.places is not None:
            assert self.routes is not None and goal_places is not None  # made with the places
            if obs.goal_index is not None:
                goal_places = goal_places[obs.goal_index.flatten()]
            here = self.places(obs.image.flatten(0, 1), self.compute_dtype)
            if self.around is not None:
                here, looked = self.around(here.view(steps, batch, -1), obs.last_action, starts,
                                           looked)
                here = here.flatten(0, 1)
                carried.append(looked)
            place, advice = self.routes(here.to(dtype), goal_places)
            inputs.append(place.view(steps, batch, -1))
            advice = advice.view(steps, batch, -1)
        hidden, state = self.memory(torch.cat(inputs, dim=-1), starts, own)
        if carried:
            state = RecurrentState(torch.cat([state.hidden, *carried], dim=1), state.cell)
        return Latents(maps, features, hidden, pose, advice=advice), state

    def maps(self, obs: Observation, starts: Tensor | None = None) -> Tensor:
        """The encoder's last maps [T*B,C,h,w].

        `starts` [T,B] as in `forward`; left out: T consecutive steps of one episode each.
        """
        if starts is None:
            starts = torch.zeros_like(obs.last_action, dtype=torch.bool)
            starts[0] = True
        goal_maps, _ = self.goal_parts(self.encode_goals(obs.goals))
        return self._look(obs, starts, self.initial_state(starts.shape[1]), goal_maps)[0]

    def goal_parts(self, goal_maps: Tensor) -> tuple[Tensor, Tensor | None]:
        """What the encoder keeps of goals, and where they were taken, out of `encode_goals`."""
        if self.places is None:
            return goal_maps, None
        width = self.places.width
        return goal_maps[:, :-width].unflatten(1, self._goal_shape), goal_maps[:, -width:]

    def _look(self, obs: Observation, starts: Tensor, state: RecurrentState,
              goal_maps: Tensor) -> tuple[Tensor, Tensor, RecurrentState]:
        frames = self._frames(obs)
        if self.config.frames > 1:
            image, before = stack_frames(frames, starts, state.hidden)
            state = RecurrentState(before, state.cell)
        else:
            image = frames.flatten(0, 1)
        index = None if obs.goal_index is None else obs.goal_index.flatten()
        return *self.encode(image, goal_maps, index), state

    def _frames(self, obs: Observation) -> Tensor:
        """What is stacked and encoded of observations, [T,B,...]."""
        return obs.image

    def read(self, latents: Latents) -> PolicyOutput:
        """Actor, critic and arrival from latents."""
        hidden = latents.hidden
        arrival = self.heads['arrival'](hidden) if 'arrival' in self.heads else None
        logits = self.actor(hidden)
        if latents.advice is not None:
            logits = logits + latents.advice
        return PolicyOutput(logits, self.critic(hidden).squeeze(-1), arrival)

    def forward(self, obs: Observation, starts: Tensor, state: RecurrentState | None = None,
                goal_maps: Tensor | None = None) -> tuple[PolicyOutput, RecurrentState]:
        """Run T steps of B environments.

        Args:
            obs: leading dimensions [T,B]; pictures uint8. Without a goal_index (T is 1) the maps
                stand in the order of the environments.
            starts: [T,B] bool, true where an episode begins: the memory is emptied before that
                row.
            state: memory before the first row; left out: empty.
            goal_maps: `encode_goals(obs.goals)`, if it is known already.

        Returns:
            The outputs, and the memory after the last row.
        """
        latents, state = self.latents(obs, starts, state, goal_maps)
        return self.read(latents), state


def _compass(pose: Pose) -> Tensor:
    """What the memory sees of a pose, [N,5]: vague where the pictures share nothing.

    Without gradient: the pose is learned from poses, not bent to please the actor.
    """
    sure = torch.sigmoid(pose.co_visible).unsqueeze(1)
    return torch.cat([sure * pose.position / 3.0, sure * pose.heading, sure], dim=1).detach()
