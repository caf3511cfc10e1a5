"""Safe model-based reinforcement learning for Stable-Baselines3: ESAD-LEND and what it is compared with."""

from pathlib import Path

import sb3_esad.envs  # noqa: F401  (registers the scenarios)
from sb3_esad.esad_lend import ADEND, ESADLEND, SADLEN
from sb3_esad.wcsac import WCSAC, SACLag

__version__ = (Path(__file__).parent / "version.txt").read_text().strip()
__all__ = ["ADEND", "ESADLEND", "SADLEN", "WCSAC", "SACLag", "__version__"]
