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
from ddqn_planner.training import ranks
ranks.join()
mine = ranks.rank() + 1.0
means = ranks.average([torch.full((2, 3), mine), torch.tensor([10 * mine, -mine])])
told = {
    "size": ranks.world_size(),
    "means": [mean.tolist() for mean in means],
    "greatest": [ranks.greatest(ranks.rank()), ranks.greatest(-ranks.rank())],
}
Path(sys.argv[1], str(ranks.rank())).write_text(json.dumps(told))
ranks.leave()
"""


def test_processes_share_the_mean_of_their_gradients_and_the_greatest_value(tmp_path: Path) -> None:
    script = tmp_path / "process.py"
    script.write_text(PROCESS)
    torchrun = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    subprocess.run([sys.executable, *torchrun, str(script), str(tmp_path)], check=True)
    for rank in "01":
        assert json.loads((tmp_path / rank).read_text()) == {
            "size": 2,
            "means": [[[1.5] * 3] * 2, [15.0, -1.5]],
            "greatest": [1, 0],
        }


def test_a_process_by_itself_keeps_its_gradients() -> None:
    ranks.join()
    gradients = (torch.ones(2), torch.zeros(3, 1))
    assert (ranks.rank(), ranks.world_size(), ranks.greatest(7)) == (0, 1, 7)
    assert ranks.average(gradients) is gradients
    ranks.leave()
