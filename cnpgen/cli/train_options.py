"""Options of ``cnpgen train`` that change the training settings."""

import argparse
import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from cnpgen.cli import values
from cnpgen.cli.parser import Parser, options_of
from cnpgen.errors import UsageError

if TYPE_CHECKING:
    from cnpgen.training.settings import TrainingSettings


def _real(text: str) -> float:
    """Read a number, "inf" or "pi"."""
    if text == "pi":
        return math.pi
    try:
        return float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"expected a number, inf or pi, got {text!r}"
        ) from None


# Options that set the field of the same name: reader of the value, choices, or None for
# a flag; placeholder; help.
_OPTIONS: dict[str, tuple[Callable[[str], Any] | tuple[str, ...] | None, str | None, str]] = {
    "hidden": (values.positive, "W", "width of the network's layers (default: 128)"),
    "layers": (values.positive, "L", "depth of its trunk (default: 5)"),
    "features": (
        ("full", "no-scene", "states", "paper"), None, "inputs: all features; all but those of obstacles that samples"
        " place; the boundary states, standardized; or divided by pi and by the limits (default: full)",
    ),
    "path_scale": (_real, "RAD", "factor of the configuration head's output (default: 0.5; pi in the paper)"),
    "head_scale": (_real, "X", "factor of the first weights of both heads (default: 0.1; 1 in the paper)"),
    "rate_bias": (_real, "X", "logarithm of the first guess of the duration factor (default: -0.5)"),
    "expected_time": (
        ("distance", "reach", "travel"), None, "unit of the network's durations: the distance over the velocity"
        " limits, at least 0.2 s; the same without a minimum (travel); or the time in which joints reach their goal"
        " states (default: distance)",
    ),
    "line_projection_steps": (
        values.natural, "N", "Gauss-Newton steps that project the line onto the manifold (default: 1; 0 for none)",
    ),
    "projection_steps": (values.natural, "N", "the same for the network's path (default: 1; 0 for none)"),
    "within_limits": (
        None, None, "keep control points within the joint limits in these steps; without equalities, in plans"
    ),
    "iterations": (
        values.positive, "N", "evaluations of the network; each after the first corrects the path of the one before"
        " (default: 1)",
    ),
    "time_parametrized": (None, None, "fit the rates to the limits after the network"),
    "path_control_points": (values.positive, "C", "control points of the path (default: those of the problem)"),
    "rate_control_points": (values.positive, "R", "control points of the rate (default: those of the problem)"),
    "objective": (
        str, "TERMS", "objective: the duration with terms such as effort=2 or effort=1,jerk=0.1; 'cnpgen list"
        " objectives' has their names (default: that of the problem)",
    ),
    "loss_form": (
        ("signed", "paper"), None,
        "form of orientation and collision losses (default: paper with --metric learned, else signed)",
    ),
    "constraint_terms": (
        ("all", "budgeted"), None,
        "constraints in the loss: all, or those with a budget, which the paper has (default: all)",
    ),
    "nodes": (values.positive, "K", "quadrature nodes of the loss (default: 32)"),
    "shifts": (values.positive, "N", "shifted sets of these nodes, used in turn (default: 16)"),
    "precision": (("float32", "float64"), None, "precision of the loss (default: float32)"),
    "batch_size": (values.positive, "B", "rows per step, or all there are (default: 64)"),
    "learning_rate": (_real, "X", "largest learning rate of Adam (default: 1e-3)"),
    "final_rate": (_real, "X", "last learning rate as a fraction of the largest one (default: 0.01)"),
    "warm_up": (values.natural, "N", "steps until the largest learning rate (default: 200)"),
    "sample_clip": (_real, "X", "largest gradient of a sample, in running medians (default: 30; inf for any)"),
    "batch_clip": (_real, "X", "largest gradient of a batch, in running norms (default: 2; inf for any)"),
    "memory": (_real, "X", "decay of the average of the parameters (default: 0.999; 0 for no average)"),
    "keep": (("best", "last"), None, "model to keep, of all validations (default: best)"),
    "validations": (values.positive, "N", "number of validations (default: 10)"),
    "seed": (values.seed, "S", "seed of the initial parameters and of the order of samples (default: 0)"),
}  # fmt: skip
_METRIC: dict[str, str] = {
    "growth": "factor by which ramped weights grow (default: 30), or by which budgets shrink (default: 1; bounded 400)",
    "gamma": "step size of a learned metric (default: 1e-2; bounded 1e-3)",
    "budget_factor": "factor of all budgets of a learned metric (default: 1)",
}


def add_settings(parser: Parser) -> None:
    """Add the options."""
    option = parser.add_argument
    for name, (read, metavar, text) in _OPTIONS.items():
        flag = f"--{name.replace('_', '-')}"
        if read is None:
            option(flag, action="store_true", default=None, help=text)
        elif isinstance(read, tuple):
            option(flag, choices=read, help=text)
        else:
            option(flag, metavar=metavar, type=read, help=text)
    metrics = ("ramped", "fixed", "learned", "bounded")
    option(
        "--metric", choices=metrics, help="weights of the constraints (default: ramped)"
    )
    for name, text in _METRIC.items():
        option(f"--{name.replace('_', '-')}", metavar="X", type=_real, help=text)
    text = "train with limits X times those of the problem, such as joint-acceleration=0.96 (default: 0.985; of"
    text += " joint-velocity 0.99); may be repeated"
    option("--margin", metavar="TERM=X", type=_margin, action="append", help=text)
    option(
        "--no-margins",
        action="store_true",
        default=None,
        help="tighten only the limits that --margin names",
    )
    option(
        "--imitate",
        metavar="X",
        type=_real,
        help="fraction of the steps, such as 0.1, that imitate the plans of a dataset made with --certify "
        "(default: 0)",
    )


def changed_settings(
    settings: "TrainingSettings", arguments: argparse.Namespace
) -> "TrainingSettings":
    """Return settings with the options that were passed.

    Refuse those without effect on the metric.
    """
    from cnpgen.training.settings import METRICS

    changes = {
        name: value
        for name, value in options_of(arguments, *_OPTIONS).items()
        if value is not None
    }
    # Options of the metric change that of ``--metric``, or else that of the preset.
    metric = settings.metric if arguments.metric is None else METRICS[arguments.metric]
    passed = {
        name: value
        for name, value in options_of(arguments, *_METRIC).items()
        if value is not None
    }
    for name in passed:
        # Weights of a ramped metric grow, without learning; those of a fixed one do
        # neither.
        if metric.kind == "fixed" or (metric.kind == "ramped" and name != "growth"):
            reason = (
                "whose weights do not grow"
                if name == "growth"
                else "which learns nothing"
            )
            raise UsageError(
                f"--{name.replace('_', '-')} changes nothing with --metric {metric.kind}, {reason}"
            )
    changes["metric"] = replace(metric, **passed)
    if arguments.margin is not None:
        changes["margins"] = dict(arguments.margin)
    if arguments.no_margins:
        changes["usual_margins"] = False
    if arguments.imitate is not None:
        changes["imitation"] = arguments.imitate
    return replace(settings, **changes)


def passed_settings(arguments: argparse.Namespace) -> Iterator[tuple[str, Any]]:
    """Yield the names and texts of the options that were passed."""
    yield from options_of(arguments, *_OPTIONS, "metric", *_METRIC).items()
    for term, factor in arguments.margin or ():
        yield "margin", f"{term}={factor:g}"
    yield from options_of(arguments, "no_margins", "imitate").items()


def _margin(text: str) -> tuple[str, float]:
    """Read TERM=X."""
    term, sign, factor = text.partition("=")
    try:
        number = float(factor)
    except ValueError:
        # Text that is no number is refused with the numbers out of range.
        number = -1.0
    if not sign or not term or not 0 < number <= 1:
        raise argparse.ArgumentTypeError(
            f"expected TERM=X with X above 0 and at most 1, got {text!r}"
        )
    return term, number
