"""Policies of ESAD-LEND by SB3's names, whose latents can be refined by diffusion."""

from sb3_esad.common.diffusion import make_head
from sb3_esad.common.policies import LatentCnnPolicy, LatentMultiInputPolicy, LatentPolicy


class MlpPolicy(LatentPolicy):
    """:class:`LatentPolicy` for vectors, with diffusion if ``head_kwargs`` has ``diffusion_steps``."""

    make_head = staticmethod(make_head)


class CnnPolicy(LatentCnnPolicy):
    """:class:`LatentCnnPolicy` for images, with diffusion if ``head_kwargs`` has ``diffusion_steps``."""

    make_head = staticmethod(make_head)


class MultiInputPolicy(LatentMultiInputPolicy):
    """:class:`LatentMultiInputPolicy` for dictionaries, with diffusion if ``head_kwargs`` has ``diffusion_steps``."""

    make_head = staticmethod(make_head)
