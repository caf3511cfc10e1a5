"""WCSAC, SAC-Lag and their policies."""

from sb3_esad.wcsac.policies import CnnPolicy, MlpPolicy, MultiInputPolicy
from sb3_esad.wcsac.wcsac import WCSAC, SACLag

__all__ = ["WCSAC", "CnnPolicy", "MlpPolicy", "MultiInputPolicy", "SACLag"]
