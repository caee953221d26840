from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import torch

from ddqn_planner.training import ranks

PROCESS = """
import json, sys
from pathlib import Path
import torch
from ddqn_planner.grid import MoveRule
from ddqn_planner.training import ranks
from ddqn_planner.training.any_map import ANY_MAP, random_scenarios
from ddqn_planner.training.trainer import Trainer
ranks.join()
trainer = Trainer(random_scenarios(0, maps=2), MoveRule.ROBOT_SAFE, ANY_MAP, seed=0)
actions = trainer._choose_actions()
mine = ranks.rank() + 1.0
means = ranks.average([torch.full((2, 3), mine), torch.tensor([10 * mine, -mine])])
told = {
    "size": ranks.world_size(),
    "means": [mean.tolist() for mean in means],
    "greatest": [ranks.greatest(ranks.rank()), ranks.greatest(-ranks.rank())],
    "weights": trainer.network.moves.weight.tolist(),
    "actions": actions.tolist(),
}
Path(sys.argv[1], str(ranks.rank())).write_text(json.dumps(told))
ranks.leave()
"""


def test_processes_share_the_mean_of_their_gradients_and_the_greatest_value(tmp_path: Path) -> None:
    script = tmp_path / "process.py"
    script.write_text(PROCESS)
    torchrun = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    subprocess.run([sys.executable, *torchrun, str(script), str(tmp_path)], check=True)
    told = [json.loads((tmp_path / rank).read_text()) for rank in "01"]
    for each in told:
        assert each["size"] == 2
        assert each["means"] == [[[1.5] * 3] * 2, [15.0, -1.5]]
        assert each["greatest"] == [1, 0]
    # They begin with the same network, and draw their steps each by itself.
    assert told[0]["weights"] == told[1]["weights"]
    assert told[0]["actions"] != told[1]["actions"]


def test_a_process_by_itself_keeps_its_gradients() -> None:
    ranks.join()
    gradients = (torch.ones(2), torch.zeros(3, 1))
    assert (ranks.rank(), ranks.world_size(), ranks.greatest(7)) == (0, 1, 7)
    assert ranks.average(gradients) is gradients
    ranks.leave()
