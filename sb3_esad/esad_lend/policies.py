"""Policies of ESAD-LEND by SB3's names, with diffusion latents, and their twins with Gaussian ones."""

from sb3_esad.common.diffusion import DiffusionHead
from sb3_esad.common.policies import LatentCnnPolicy, LatentMultiInputPolicy, LatentPolicy


class MlpPolicy(LatentPolicy):
    """Policy for vectors, whose latents are refined by diffusion."""

    head_class = DiffusionHead


class CnnPolicy(LatentCnnPolicy):
    """Policy for images, whose latents are refined by diffusion."""

    head_class = DiffusionHead


class MultiInputPolicy(LatentMultiInputPolicy):
    """Policy for dictionaries of images and vectors, whose latents are refined by diffusion."""

    head_class = DiffusionHead


GaussianMlpPolicy = LatentPolicy
GaussianCnnPolicy = LatentCnnPolicy
GaussianMultiInputPolicy = LatentMultiInputPolicy
