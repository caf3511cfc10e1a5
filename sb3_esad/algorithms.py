"""The algorithms of this package, by the names that commands, RL Zoo and the files of ``hyperparams/`` have for them."""

from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_esad.esad_lend import ADEND, ESADLEND, SADLEN
from sb3_esad.wcsac import WCSAC, SACLag

ALGORITHMS: dict[str, type[OffPolicyAlgorithm]] = {
    "esad_lend": ESADLEND,
    "sad_len": SADLEN,
    "ad_end": ADEND,
    "wcsac": WCSAC,
    "sac_lag": SACLag,
}
