"""ESAD-LEND and its policies."""

from sb3_esad.esad_lend.esad_lend import ESADLEND
from sb3_esad.esad_lend.policies import CnnPolicy, MlpPolicy, MultiInputPolicy

__all__ = ["ESADLEND", "CnnPolicy", "MlpPolicy", "MultiInputPolicy"]
