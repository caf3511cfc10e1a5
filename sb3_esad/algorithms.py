"""The algorithms of this package, by the names that commands, RL Zoo and the files of ``hyperparams/`` have for them."""

from pathlib import Path
from typing import Any

from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_esad.common.description import described_class
from sb3_esad.esad_lend import ADEND, ESADLEND, SADLEN
from sb3_esad.wcsac import WCSAC, SACLag

ALGORITHMS: dict[str, type[OffPolicyAlgorithm]] = {
    "esad_lend": ESADLEND,
    "sad_len": SADLEN,
    "ad_end": ADEND,
    "wcsac": WCSAC,
    "sac_lag": SACLag,
}


def load_model(path: Path, trusted: bool = False) -> Any:
    """
    Load a saved model of any algorithm of this package.

    :param path: its zip
    :param trusted: let it run what code it holds
    :return: the model
    :raises ValueError: if the file is missing, damaged, or holds something else, or if its observations were normalised
    """
    run = path.resolve().parent  # RL Zoo's folder ENV_N holds the statistics of a training in its folder ENV
    env_id, numbered, _ = run.name.rpartition("_")
    if numbered and (run / env_id / "vecnormalize.pkl").exists():
        reason = f"{path} was trained on observations that RL Zoo normalised, by statistics that lie beside it"
        raise ValueError(f"{reason}: evaluate it by python -m sb3_esad enjoy, which reads them.")
    by_class = {algorithm.__name__: algorithm for algorithm in ALGORITHMS.values()}
    return by_class.get(described_class(path), ESADLEND).load(path, trusted=trusted)
