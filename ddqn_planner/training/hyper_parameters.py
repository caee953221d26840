"""All hyper-parameters of training, once for nodes, command line and tests."""

from dataclasses import dataclass, field, fields
from typing import Any

from ddqn_planner.grid.arguments import real


def _number(default: Any, source: str, low: float, high: float) -> Any:
    """Declare a number from `low` to `high`; `source` tells where `default` is from."""
    return field(default=default, metadata={"source": source, "range": (low, high)})


def _choice(*choices: str, source: str) -> Any:
    """Declare a text, one of `choices`; the first one is the default."""
    return field(default=choices[0], metadata={"source": source, "choices": choices})


@dataclass(frozen=True)
class HyperParameters:
    """The paper's Table 1, and our values where it gives none.

    Examples
    --------
    >>> from ddqn_planner.training import HyperParameters
    >>> parameters = HyperParameters(steps=20_000, target="dqn")
    >>> parameters
    HyperParameters(target='dqn', steps=20000)
    >>> parameters.gamma, parameters.learning_rate_at(step=20_000)
    (0.95, 0.0005)
    """

    # p_r = 0 switches off improvement 1 (initialisation), alpha = beta = 0 switches off
    # improvement 2 (reward).
    network: str = _choice(
        "paper", "propagation", "any_map", source="ours: the Q-network, see model/"
    )
    target: str = _choice(
        "double_dqn",
        "dqn",
        source="ours: the target, see training/double_dqn.py",
    )
    reward: str = _choice(
        "paper", "path_cost", source="ours: the reward, see training/reward.py"
    )
    learning_rate: float = _number(
        0.01, "section on the network: Adam's first learning rate", 1e-6, 1.0
    )
    learning_rate_decay: float = _number(
        0.05, "ours: Adam's last learning rate over its first; 1 keeps it", 1e-6, 1.0
    )
    weight_decay: float = _number(
        0.0,
        "ours: weights lose this times the learning rate per update, as in AdamW "
        "(Loshchilov and Hutter 2019)",
        0.0,
        100.0,
    )
    weight_averaging: float = _number(
        0.0,
        "ours: share of the new weights in an average, which is the model "
        "(Polyak and Juditsky 1992); 0 for the last weights",
        0.0,
        1.0,
    )
    priority: float = _number(
        0.0,
        "ours: exponent of the error by which a transition is drawn again "
        "(Schaul et al. 2016); 0 draws all alike",
        0.0,
        1.0,
    )
    batch_size: int = _number(32, "Table 1: transitions in a mini-batch", 1, 4096)
    gamma: float = _number(0.95, "Table 1: discount γ", 0.0, 1.0)
    obstacle_reward: float = _number(-10.0, "Table 1: reward of a collision", -1e3, 0.0)
    goal_reward: float = _number(10.0, "Table 1: reward of the end", 0.0, 1e3)
    p_r: float = _number(
        0.5, "section 4.1: probability of a random initial cell", 0.0, 1.0
    )
    alpha: float = _number(
        0.6, "section 4.2: weight α of the progress to the end", 0.0, 10.0
    )
    beta: float = _number(
        0.4, "section 4.2: weight β of the detour from the start", 0.0, 10.0
    )
    steps: int = _number(50_000, "section 5.1: environment steps of goal i", 1, 10**9)
    filters: int = _number(16, "ours: filters of the convolution", 1, 1024)
    hidden_units: int = _number(
        0, "ours: units of a hidden layer after the convolution; 0 for none", 0, 4096
    )
    replay_capacity: int = _number(
        50_000, "ours: transitions in the replay buffer", 1, 10**7
    )
    learning_starts: int = _number(
        500, "ours: environment steps before learning", 0, 10**6
    )
    update_interval: int = _number(1, "ours: environment steps per update", 1, 10**4)
    target_interval: int = _number(500, "ours: updates per target copy (N)", 1, 10**6)
    epsilon_start: float = _number(1.0, "ours: ε at the first step", 0.0, 1.0)
    epsilon_end: float = _number(0.1, "ours: ε after the decline", 0.0, 1.0)
    epsilon_steps: int = _number(10_000, "ours: steps of ε's linear decline", 1, 10**9)
    max_episode_steps: int = _number(200, "ours: steps that end an episode", 1, 10**6)
    environments: int = _number(1, "ours: environments stepped at once", 1, 4096)

    def __repr__(self) -> str:
        """Return the Python code that makes it: all values but the defaults."""
        values = [
            f"{entry.name}={getattr(self, entry.name)!r}"
            for entry in fields(self)
            if getattr(self, entry.name) != entry.default
        ]
        return f"HyperParameters({', '.join(values)})"

    def learning_rate_at(self, step: int) -> float:
        """Return the learning rate at an environment step: it falls exponentially."""
        share: float = min(step / self.steps, 1.0)
        return float(self.learning_rate * self.learning_rate_decay**share)

    def __post_init__(self) -> None:
        """Check all values, and make them Python's numbers."""
        for entry in fields(self):
            value = getattr(self, entry.name)
            if "choices" in entry.metadata:
                _check_choice(entry.name, value, entry.metadata["choices"])
                continue
            is_whole = entry.type in (int, "int")
            number = _checked_number(
                entry.name, value, entry.metadata["range"], is_whole
            )
            # Numbers of any type become Python's, as dataclasses set them.
            object.__setattr__(self, entry.name, number)
        if self.network != "paper":
            for name in ("weight_decay", "weight_averaging", "priority"):
                if getattr(self, name) != 0:
                    raise ValueError(
                        f"{name} is {getattr(self, name)}; give 0, or the network paper"
                    )
        if self.environments > self.replay_capacity:
            raise ValueError(
                f"environments is {self.environments}; give at most replay_capacity, "
                f"{self.replay_capacity}"
            )


def _check_choice(name: str, value: object, choices: tuple[str, ...]) -> None:
    """Raise a ValueError unless the value of a parameter is one of its choices."""
    if not isinstance(value, str) or value not in choices:
        raise ValueError(f"{name} is {value!r}; give one of {', '.join(choices)}")


def _checked_number(
    name: str, value: object, limits: tuple[float, float], is_whole: bool
) -> float:
    """Return the value of a parameter as a Python number, an int if `is_whole`.

    `name` is the parameter's. A ValueError if the value is no such number, or outside
    its limits (lowest, highest).
    """
    number = real(value)
    low, high = limits
    if isinstance(value, bool) or not low <= number <= high:
        raise ValueError(f"{name} is {value!r}; it must lie in {low} to {high}")
    if is_whole and not number.is_integer():
        raise ValueError(f"{name} is {value!r}; give a whole number")
    return int(number) if is_whole else number
