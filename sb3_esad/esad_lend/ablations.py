"""ESAD-LEND with one of its parts replaced (arXiv 2407.06317, Sec. V)."""

from typing import ClassVar

from stable_baselines3.common.policies import BasePolicy

from sb3_esad.common.latent_algorithm import LatentAlgorithm
from sb3_esad.common.penalties import NoPenalty
from sb3_esad.common.selection import NoFilter
from sb3_esad.esad_lend.esad_lend import ESADLEND


class SADLEN(ESADLEND):
    """ESAD-LEND with Gaussian latents: the ablation without diffusion."""

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = LatentAlgorithm.policy_aliases


class ADEND(ESADLEND):
    """ESAD-LEND without its guarantee of safety: costs are predicted and logged, never limited."""

    penalty_class = NoPenalty
    filter_class = NoFilter
