import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from limits import memory_grows_less_than
from safetensors import safe_open

from ddqn_planner import GridMap, MoveRule, PlanStatus
from ddqn_planner.grid import legal_moves
from ddqn_planner.model import load_model
from ddqn_planner.planning import QField
from ddqn_planner.training.double_dqn import Transitions
from ddqn_planner.training.environment import Scenario
from ddqn_planner.training.episodes import Episode, EpisodeEnd
from ddqn_planner.training.evaluation import evaluate, length_ratios
from ddqn_planner.training.hyper_parameters import HyperParameters
from ddqn_planner.training.trainer import CheckpointError, Trainer

QUICK = HyperParameters(
    learning_rate=0.003,
    filters=8,
    learning_starts=50,
    epsilon_steps=1500,
    target_interval=100,
)


def make(
    scenario: Scenario, parameters: HyperParameters = QUICK, seed: int = 0
) -> Trainer:
    return Trainer([scenario], parameters, seed)


def train(trainer: Trainer, until: int) -> list[Episode]:
    return [episode for progress in trainer.run(until) for episode in progress.episodes]


def same_weights(a: dict[str, Any], b: dict[str, Any]) -> bool:
    return all(map(np.array_equal, a.values(), b.values()))


@pytest.fixture(scope="module")
def trained(small: Scenario) -> tuple[Trainer, list[Episode]]:
    """A trainer that has learned the map `small`, and its episodes."""
    trainer = make(small, replace(QUICK, max_episode_steps=20))
    return trainer, train(trainer, 3000)


def test_training_learns_a_path(trained: Any, small: Scenario) -> None:
    field = trained[0].planner().q_field(small.grid, small.goal)
    evaluation = evaluate(field, small.grid, MoveRule.ROBOT_SAFE)
    assert evaluation.solved == evaluation.starts
    assert evaluation.mean_ratio < 1.2
    assert field.rollout(small.start).status is PlanStatus.SUCCEEDED
    assert field.q[6, 1, 4] == pytest.approx(10.0, abs=0.6)  # onto the goal
    assert field.q[0, 1, 4] == pytest.approx(-10.0, abs=0.6)  # off the map


def test_episodes_say_how_they_ended(trained: Any, small: Scenario) -> None:
    _, episodes = trained
    assert [episode.number for episode in episodes] == list(range(1, len(episodes) + 1))
    assert {episode.outcome for episode in episodes} == set(EpisodeEnd)
    steps = 0
    for episode in episodes:
        steps += episode.moves
        assert episode.step == steps
        assert all(small.grid.is_free(cell) for cell in episode.cells)
        assert episode.average_reward == episode.total_reward / episode.moves
        collided = episode.outcome is EpisodeEnd.COLLIDED
        assert episode.moves == len(episode.cells) - (0 if collided else 1)
        assert (episode.cells[-1] == small.goal) == (
            episode.outcome is EpisodeEnd.REACHED_GOAL
        )
        if episode.outcome is EpisodeEnd.OUT_OF_STEPS:
            assert episode.moves == 20


@pytest.mark.parametrize("network", ["paper", "propagation", "any_map"])
def test_weights_begin_as_those_of_torch(small: Scenario, network: str) -> None:
    tensors = make(
        small, HyperParameters(network=network, hidden_units=3)
    ).network.tensors
    prices = tensors.pop("prices.bias", np.ones(8))
    assert (prices == 1).all()  # a multiplier below 1 has no gradient
    seed, *_ = np.random.SeedSequence(0).spawn(4)
    torch.manual_seed(int(seed.generate_state(1)[0]))
    for name in [name for name in tensors if name.endswith("weight")]:
        outputs, *inputs = tensors[name].shape
        is_dense = len(inputs) == 1
        layer = (
            torch.nn.Linear(*inputs, outputs)
            if is_dense
            else torch.nn.Conv2d(1, outputs, 3)
        )
        for part, expected in layer.state_dict().items():
            found = tensors.get(name.replace("weight", part), expected)
            np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("rule", MoveRule)
def test_a_propagation_network_learns(
    small: Scenario, paper: Scenario, rule: MoveRule
) -> None:
    quick = {
        "learning_rate": 0.003,
        "batch_size": 256,
        "filters": 32,
        "environments": 8,
    }
    quick |= {"target_interval": 50, "update_interval": 8}
    parameters = HyperParameters(network="propagation", **quick)
    trainer = Trainer([replace(paper, move_rule=rule)], parameters, seed=0)
    train(trainer, 8000)
    for scenario in (paper, small):
        field = trainer.planner().q_field(scenario.grid, scenario.goal)
        evaluation = evaluate(field, scenario.grid, rule)
        assert evaluation.solved == evaluation.starts
        assert evaluation.worst_ratio == pytest.approx(1.0)


@pytest.mark.parametrize("network", ["paper", "propagation"])
@pytest.mark.parametrize("environments", [1, 3])
@pytest.mark.parametrize("first", [20, 301])
def test_an_interrupted_training_continues_bit_for_bit_and_another_seed_gives_another(
    small: Scenario, tmp_path: Path, environments: int, first: int, network: str
) -> None:
    changes = {"replay_capacity": 200, "update_interval": 2, "target_interval": 30}
    parameters = replace(QUICK, environments=environments, network=network, **changes)
    longer = parameters  # a rate that falls depends on how long the training takes
    if first == 20:
        parameters = replace(parameters, learning_rate_decay=1.0)
        longer = replace(parameters, steps=7)
    elif network == "paper":
        parameters = replace(
            parameters, weight_decay=0.2, weight_averaging=0.01, priority=0.4
        )
        longer = parameters
    uninterrupted, interrupted, other = (
        make(small, parameters, seed) for seed in (0, 0, 1)
    )
    episodes = train(uninterrupted, 400)
    before = train(interrupted, first)
    interrupted.save_checkpoint(tmp_path / "checkpoint")
    resumed = make(small, longer)
    resumed.restore(tmp_path / "checkpoint")
    assert before + train(resumed, 400) == episodes
    assert same_weights(uninterrupted.network.tensors, resumed.network.tensors)
    models = uninterrupted.planner().network, resumed.planner().network
    assert same_weights(models[0].tensors, models[1].tensors)
    for name in ("steps", "updates", "episodes", "epsilon"):
        assert getattr(uninterrupted, name) == getattr(resumed, name)
    train(other, 100)
    assert not same_weights(uninterrupted.network.tensors, other.network.tensors)


@pytest.mark.parametrize(("environments", "interval"), [(1, 1), (3, 2), (3, 5), (4, 3)])
def test_updates_keep_their_ratio(
    small: Scenario, environments: int, interval: int
) -> None:
    changes = {
        "environments": environments,
        "update_interval": interval,
        "learning_starts": 0,
    }
    trainer = make(small, replace(QUICK, **changes))
    train(trainer, 120)
    assert trainer.updates == trainer.steps // interval


def test_learning_starts_and_targets_are_copied_when_the_parameters_say(
    small: Scenario,
) -> None:
    trainer = make(small, replace(QUICK, learning_starts=5, target_interval=3))
    train(trainer, 5)
    assert trainer.updates == 0
    for _ in trainer.run(13, every=1):
        learned = trainer.learned
        is_copied = same_weights(learned.online, learned.target)
        assert is_copied == (trainer.updates % 3 == 0)
    assert trainer.updates == 8


def test_epsilon_falls_linearly_and_then_stays(small: Scenario) -> None:
    trainer = make(
        small, HyperParameters(epsilon_start=0.8, epsilon_end=0.2, epsilon_steps=100)
    )
    for trainer.steps, epsilon in (
        (0, 0.8),
        (25, 0.65),
        (100, 0.2),
        (101, 0.2),
        (1000, 0.2),
    ):
        assert trainer.epsilon == pytest.approx(epsilon)


def test_an_episode_adds_up_its_own_rewards_alone(small: Scenario) -> None:
    free = replace(QUICK, alpha=0.0, beta=0.0, max_episode_steps=5, epsilon_end=1.0)
    episodes = train(make(small, replace(free, learning_starts=10**6)), 1000)
    totals = {
        EpisodeEnd.REACHED_GOAL: 10.0,
        EpisodeEnd.COLLIDED: -10.0,
        EpisodeEnd.OUT_OF_STEPS: 0,
    }
    assert {(each.outcome, each.total_reward) for each in episodes} == {*totals.items()}


def test_a_saved_model_plans_as_its_trainer(small: Scenario, tmp_path: Path) -> None:
    small = replace(small, move_rule=MoveRule.CORNER_CUTTING)
    other = replace(small, grid=GridMap(np.zeros((4, 5))))
    trainer = Trainer([small, other], replace(QUICK, gamma=0.8), seed=3)
    train(trainer, 2)
    (tmp_path / "model.safetensors").write_bytes(trainer.model_bytes())
    network, found = load_model(tmp_path / "model.safetensors")
    expected = (
        trainer.planner().q_field(small.grid, small.goal, MoveRule.CORNER_CUTTING).q
    )
    assert (
        network.q_values(small.grid, small.goal, MoveRule.CORNER_CUTTING) == expected
    ).all()
    said = found.network, found.gamma, found.move_rule, found.seed, found.steps
    assert said == ("paper", 0.8, MoveRule.CORNER_CUTTING, 3, 2)
    assert found.map_fingerprint == small.grid.fingerprint != other.grid.fingerprint


BRIEF = replace(QUICK, replay_capacity=100)


@pytest.fixture
def checkpoint(small: Scenario, tmp_path: Path) -> Path:
    trainer = make(small, BRIEF)
    train(trainer, 60)
    trainer.save_checkpoint(tmp_path / "checkpoint.safetensors")
    return tmp_path / "checkpoint.safetensors"


def test_the_format_of_a_checkpoint_stays(checkpoint: Path) -> None:
    with safe_open(checkpoint, framework="np") as file:
        metadata = file.metadata()
        shapes = {key: file.get_slice(key).get_shape() for key in file.keys()}  # noqa: SIM118
    assert {*metadata} == {"ddqn_planner_checkpoint", "sha256"}
    names = [
        "seed",
        "move_rule",
        "parameters",
        "scenarios",
        "counters",
        "walked",
        "generators",
    ]
    assert [*json.loads(metadata["ddqn_planner_checkpoint"])] == names
    network = {"convolution.weight": [8, 1, 3, 3], "convolution.bias": [8]}
    network |= {"fully_connected.weight": [8, 48], "fully_connected.bias": [8]}
    expected: dict[str, list[int]] = {"total_reward": [1]}
    expected |= {f"replay.{name}": [60] for name in Transitions._fields}
    expected |= {f"environment.{name}": [1] for name in ("scenario", "cell", "steps")}
    for number, (name, shape) in enumerate(network.items()):
        expected |= {f"network.{name}": shape, f"target.{name}": shape}
        moments = {"step": [], "exp_avg": shape, "exp_avg_sq": shape}
        expected |= {
            f"optimiser.{number}.{moment}": size for moment, size in moments.items()
        }
    assert shapes == expected


def test_a_wrong_checkpoint_is_refused(
    small: Scenario, paper: Scenario, checkpoint: Path
) -> None:
    for other in (paper, replace(small, start=(0, 1)), replace(small, goal=(4, 1))):
        with pytest.raises(CheckpointError, match="another map, start or goal"):
            make(other, BRIEF).restore(checkpoint)
    content = checkpoint.read_bytes()
    random = np.random.default_rng(0)
    header = 8 + int.from_bytes(content[:8], "little")
    broken = [content[: int(part * len(content))] for part in (0.0, 0.3, 0.9)]
    for position in [
        *random.integers(header, size=30),
        *random.integers(len(content), size=30),
    ]:
        flipped = bytearray(content)
        flipped[position] ^= 1 << random.integers(8)
        broken.append(bytes(flipped))
    for bad in broken:
        checkpoint.write_bytes(bad)
        # Another bit in a fingerprint is another map.
        with pytest.raises(CheckpointError, match="or train into another folder"):
            make(small, BRIEF).restore(checkpoint)


def test_only_a_broken_checkpoint_should_be_removed(
    small: Scenario, checkpoint: Path, tmp_path: Path
) -> None:
    trainer = make(small, BRIEF)
    notes, model, broken = (tmp_path / name for name in ("notes", "model", "broken"))
    notes.write_text("mine")
    trainer.planner().save(model)
    broken.write_bytes(checkpoint.read_bytes()[:-1])
    for path, problem in (
        (tmp_path / "none", "no such file"),
        (tmp_path, "is a folder"),
        (notes, "is no checkpoint"),
        (model, "is no checkpoint"),
    ):
        with pytest.raises(CheckpointError, match="give the path of a") as error:
            trainer.restore(path)
        assert problem in str(error.value)
        assert "remove" not in str(error.value)
    with pytest.raises(CheckpointError, match="remove it to train anew, or") as error:
        trainer.restore(broken)
    assert "Error(" not in str(error.value)
    with pytest.raises(ValueError, match="the checkpoint is None; give a str or"):
        trainer.restore(None)  # type: ignore[arg-type]


def test_a_checkpoint_of_holes_is_refused_unread(
    small: Scenario, checkpoint: Path
) -> None:
    header = json.loads(checkpoint.read_bytes()[8:].split(b"}}", 1)[0] + b"}}")
    size = 2**30
    for entry in header.values():
        if "data_offsets" in entry:
            entry.update(shape=[0], data_offsets=[size, size])
    header["network.convolution.weight"].update(
        shape=[size // 4], data_offsets=[0, size]
    )
    text = json.dumps(header).encode()
    with checkpoint.open("wb") as file:
        file.write(len(text).to_bytes(8, "little") + text)
        file.truncate(file.tell() + size)
    with (
        memory_grows_less_than(130),
        pytest.raises(CheckpointError, match="names or shapes"),
    ):
        make(small, BRIEF).restore(checkpoint)


def test_a_parameter_out_of_range_is_named() -> None:
    wrong = {
        "target": "sarsa",
        "gamma": 1.5,
        "batch_size": 0,
        "learning_rate": float("nan"),
    }
    for name, value in wrong.items():
        with pytest.raises(ValueError, match=f"{name} is {value!r}"):
            HyperParameters(**{name: value})


RULE = MoveRule.ROBOT_SAFE
GRID = GridMap(np.array([[0, 0, 0, 1, 0], [0, 0, 0, 1, 0]]))


def field_of(actions: list[list[int]]) -> QField:
    """The field toward (2, 0) that prefers one action in each cell."""
    q = np.zeros((8, *GRID.occupancy.shape), dtype=np.float32)
    for y, x in np.ndindex(GRID.occupancy.shape):
        q[actions[y][x], y, x] = 1
    return QField((2, 0), q, legal_moves(GRID.occupancy, RULE))


def test_a_detour_counts_with_its_length_and_a_trapped_rollout_is_left_out() -> None:
    # (0, 1) goes by (0, 0), (1, 1) and (2, 1) go to each other; nothing joins (4, 0) to
    # the goal.
    field = field_of([[0, 0, 0, 0, 0], [6, 0, 4, 0, 0]])
    detour = 3 / (1 + 2**0.5)
    ratios = [[1, 1, np.nan, np.nan, np.nan], [detour, np.inf, np.inf, np.nan, np.nan]]
    np.testing.assert_allclose(length_ratios(field, GRID, RULE), ratios)
    evaluation = evaluate(field, GRID, RULE)
    assert (evaluation.starts, evaluation.solved) == (5, 3)
    assert evaluation.mean_ratio == pytest.approx((2 + detour) / 3)
    assert evaluation.worst_ratio == pytest.approx(detour)
    # Nobody reaches the goal.
    evaluation = evaluate(field_of([[2, 2, 0, 0, 0], [6, 6, 4, 0, 0]]), GRID, RULE)
    assert evaluation == pytest.approx((5, 0, np.nan, np.nan), nan_ok=True)
