"""ESAD-LEND, its ablations and its policies."""

from sb3_esad.esad_lend.ablations import ADEND, SADLEN
from sb3_esad.esad_lend.esad_lend import ESADLEND
from sb3_esad.esad_lend.policies import CnnPolicy, MlpPolicy, MultiInputPolicy

__all__ = ["ADEND", "ESADLEND", "SADLEN", "CnnPolicy", "MlpPolicy", "MultiInputPolicy"]
