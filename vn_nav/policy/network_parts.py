"""Makes the parts of a policy network by its configuration."""

from __future__ import annotations

from torch import nn

from vn_nav.policy.encoders import Encoder, Fused, Matching, OneStream, TwoStreams
from vn_nav.policy.heads import GoalPose, ImageHead, PixelControl, RewardPrediction, Scalar
from vn_nav.policy.network_config import IMAGE_HEADS, NetworkConfig

PUBLISHED: dict[str, type[TwoStreams | OneStream]] = {'thesis': TwoStreams, 'unreal': OneStream}
OWN: dict[str, type[Fused | Matching]] = {'fused': Fused, 'matching': Matching}


def build_encoder(config: NetworkConfig) -> Encoder:
    """The encoder of an architecture."""
    pixels = config.pixel_mean, config.pixel_std, config.frames
    if config.architecture in PUBLISHED:
        return PUBLISHED[config.architecture](config.size, *pixels)
    return OWN[config.architecture](config.size, config.channels, config.features, config.blocks,
                                    *pixels)


def build_head(name: str, config: NetworkConfig, channels: int, side: int, features: int
               ) -> nn.Module:
    """An auxiliary head.

    Args:
        name: of the head.
        config: of the network.
        channels, side: of the encoder's last maps.
        features: of the encoder.
    """
    if name == 'pixel_control':
        return PixelControl(config.hidden, len(config.actions), side, config.deconvolutions)
    if name == 'reward_prediction':
        return RewardPrediction(channels * side**2)
    if name in IMAGE_HEADS:
        out, width = IMAGE_HEADS[name]
        return ImageHead(channels, width, out, config.deconvolutions)
    if name == 'goal_pose':
        return GoalPose(features)
    return Scalar(config.hidden)


def initialise(layer: nn.Linear, gain: float, thesis: bool) -> None:
    """Initial weights of actor or critic: uniform as in the thesis, or orthogonal."""
    if thesis:
        bound = layer.in_features**-0.5
        nn.init.uniform_(layer.weight, -bound, bound)
    else:
        nn.init.orthogonal_(layer.weight, gain)
    nn.init.zeros_(layer.bias)
