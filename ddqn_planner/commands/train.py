"""``ddqn-planner train``: trains a model on one map by the paper's method."""

import json
import math
import sys
from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TextIO

from ddqn_planner.commands.options import (
    Option,
    add_map_options,
    add_options,
    files_of,
    read_map,
)
from ddqn_planner.commands.training_options import (
    add_training_options,
    exit_code_of,
    hyper_parameters_of,
    opened_training,
    stop_report,
    train_with_bar,
)
from ddqn_planner.files import check_distinct, check_writable
from ddqn_planner.grid import MapFile, MoveRule
from ddqn_planner.pictures import film_format, picture_format
from ddqn_planner.training.curve_file import CURVE, CurveFile
from ddqn_planner.training.episodes import Progress
from ddqn_planner.training.hyper_parameters import HyperParameters
from ddqn_planner.training.scenario import Scenario
from ddqn_planner.training.training_estimate import estimate
from ddqn_planner.training.training_record import TrainingRecord

if TYPE_CHECKING:
    from ddqn_planner.training.event_files import EventFiles
    from ddqn_planner.training.run import TrainingRun

OPTIONS: Final = (
    Option("picture", Path, None, "draw the end: solved starts, path and curve"),
    Option("film", Path, None, "film the training: .gif, .webp or animated .png"),
    Option("tensorboard", Path, None, "folder for TensorBoard's event files"),
    Option("json", bool, False, "print JSON instead of a table"),
)


def run(parser: ArgumentParser, arguments: Sequence[str]) -> int:
    """Train, and print what the greedy rollouts solve, as a table or as JSON.

    `parser` gets the command's options, which `arguments` give. Returns the exit code,
    see `exit_code_of`.
    """
    add_map_options(parser, "corner_cutting")
    add_options(parser, *OPTIONS)
    add_training_options(parser, "runs/train", HyperParameters())
    options = parser.parse_args(arguments)
    map_file, start, goal = read_map(options)
    scenario = Scenario(map_file.grid(), start, goal, MoveRule(options.move_rule))
    _check_outputs(options, map_file)
    warning = estimate([scenario], hyper_parameters_of(options)).warning
    if warning:
        print(f"ddqn-planner: {warning}", file=sys.stderr)
    with opened_training(options, lambda: [scenario]) as training:
        # With --json, the object alone goes to stdout.
        output = sys.stderr if options.json else sys.stdout
        print(training.description, file=output, flush=True)
        record = _train_and_record(options, training)
    if options.json:
        print(json.dumps(_entries(options, training, record), allow_nan=False))
    else:
        print(*_lines(training, record), sep="\n")
    if not training.is_complete:
        print(stop_report(training), file=output, flush=True)
    # After the results: to draw takes seconds, which Ctrl-C may cut off.
    _draw(options, record, output)
    return exit_code_of(training)


def _train_and_record(options: Namespace, training: "TrainingRun") -> TrainingRecord:
    """Train, and return the record, which continues that of an earlier process."""
    curve_file = CurveFile(training.folder / CURVE, training.saved_at)
    training.callback(curve_file.close)
    record = TrainingRecord(training.trainer, earlier_curve=curve_file.earlier)
    watcher = _Watcher(record, curve_file, _event_files(options, training))
    train_with_bar(training, watcher)
    watcher.finish()
    return record


def _draw(options: Namespace, record: TrainingRecord, output: TextIO) -> None:
    """Save the picture and the film that the options ask for; tell so on `output`."""
    if options.picture:
        record.save_picture(options.picture)
        print(f"saved {options.picture}", file=output)
    if options.film:
        print(f"drawing {len(record.snapshots)} frames", file=output, flush=True)
        record.save_film(options.film)
        print(f"saved {options.film}", file=output)


def _check_outputs(options: Namespace, map_file: MapFile) -> None:
    """Raise an error if a file cannot be written, before hours of training."""
    for option in ("picture", "film"):
        file = getattr(options, option)
        if file:
            check_writable(file, f"--{option}")
    if options.picture:
        picture_format(options.picture, "--picture")
    if options.film:
        import_module("matplotlib")
        film_format(options.film, "--film")
    outputs = {"--picture": options.picture, "--film": options.film}
    check_distinct(outputs, files_of(map_file))
    if options.tensorboard:
        import_module("tensorboard")
        check_writable(options.tensorboard / "events", "--tensorboard")


def _event_files(options: Namespace, training: "TrainingRun") -> "EventFiles | None":
    """Open the event files of ``--tensorboard``, and close them with the training."""
    if not options.tensorboard:
        return None
    from ddqn_planner.training.event_files import EventFiles

    event_files = EventFiles(options.tensorboard)
    training.callback(event_files.close)
    return event_files


class _Watcher:
    """Takes the progress of a training, and returns what stands beside its bar."""

    def __init__(
        self,
        record: TrainingRecord,
        curve_file: CurveFile,
        event_files: "EventFiles | None",
    ) -> None:
        """Write the first evaluation, too."""
        self.record = record
        self.curve_file = curve_file
        self.event_files = event_files
        self._write()

    def __call__(self, progress: Progress) -> dict[str, object]:
        """Add a progress to the record, and write an evaluation if one was due."""
        if self.record.add(progress) is not None:
            self._write()
        point = self.record.curve[-1]
        figures: dict[str, object] = {"solved": f"{point.solved_share:.0%}"}
        if not math.isnan(point.reward_per_step):
            figures["reward per step"] = point.reward_per_step
        return figures

    def finish(self) -> None:
        """Evaluate the present network, and write that, too."""
        last_point = self.record.curve[-1]
        if self.record.evaluate() is not last_point:
            self._write()

    def _write(self) -> None:
        """Write the last evaluation into the curve's file, and the event files."""
        self.curve_file.add(self.record.curve[-1])
        if self.event_files is not None:
            self.event_files.add(self.record.curve[-1])


def _lines(training: "TrainingRun", record: TrainingRecord) -> list[str]:
    """Return the lines of a table that tells the results of a training."""
    point = record.curve[-1]
    trainer = training.trainer
    rows = {
        "solved starts": f"{point.solved:,} of {point.starts:,}",
        "length over optimum": "none is solved",
        "from the given start": "it is trapped",
        "solved for good": "from the given start "
        f"{_since(record, record.start_solved_for_good())}, "
        f"from all {_since(record, record.all_solved_for_good())}",
        "training": f"{trainer.steps:,} steps, {trainer.episodes:,} episodes, "
        f"{_duration(point.seconds)}",
        "model": str(training.model_path),
    }
    if point.solved:
        rows["length over optimum"] = (
            f"mean {point.mean_ratio:.4f}, worst {point.worst_ratio:.4f}"
        )
    if math.isfinite(point.start_ratio):
        length = point.start_ratio * record.optimum
        rows["from the given start"] = f"{length:.2f}, optimum {record.optimum:.2f}"
    first_step = record.curve[0].step
    if first_step:
        rows["training"] += f" since step {first_step:,}"
    return [f"{name:22}{text}" for name, text in rows.items()]


def _since(record: TrainingRecord, step: int | None) -> str:
    """Return in words from which step on starts are solved; None for never."""
    if step is None:
        return "not yet"
    if step == record.curve[0].step:
        return f"at step {step:,} or before" if step else "before the training"
    return f"after {step:,} steps"


def _duration(seconds: float) -> str:
    """Return a time as a person reads it: "5.2 s", or "1:02:03 h"."""
    if seconds < 100:
        return f"{seconds:.1f} s"
    minutes, second = divmod(round(seconds), 60)
    hour, minute = divmod(minutes, 60)
    return f"{hour}:{minute:02}:{second:02} h"


def _entries(
    options: Namespace, training: "TrainingRun", record: TrainingRecord
) -> dict[str, Any]:
    """Return the JSON object of ``--json``. What is not finite is null."""
    trainer = training.trainer
    point = record.curve[-1]
    is_solved = math.isfinite(point.start_ratio)
    files = {
        name: None if path is None else str(path)
        for name, path in (
            ("model", training.model_path),
            ("picture", options.picture),
            ("film", options.film),
            ("tensorboard", options.tensorboard),
        )
    }
    curve = [
        {name: value if math.isfinite(value) else None for name, value in row.items()}
        for row in (point._asdict() for point in record.curve)
    ]
    return {
        "is_complete": training.is_complete,
        "first_step": record.curve[0].step,
        "episodes": trainer.episodes,
        **curve[-1],
        "length": point.start_ratio * record.optimum if is_solved else None,
        "optimum": record.optimum,
        "start_solved_for_good": record.start_solved_for_good(),
        "all_solved_for_good": record.all_solved_for_good(),
        "files": files,
        "curve": curve,
    }
