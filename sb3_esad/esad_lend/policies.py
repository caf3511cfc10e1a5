"""Policies of ESAD-LEND by SB3's names."""

from sb3_esad.common.policies import LatentCnnPolicy, LatentMultiInputPolicy, LatentPolicy

MlpPolicy = LatentPolicy
CnnPolicy = LatentCnnPolicy
MultiInputPolicy = LatentMultiInputPolicy
