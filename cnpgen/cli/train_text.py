"""Output of ``cnpgen train``: a bar, a line per validation, a summary."""

import sys
import textwrap
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from cnpgen.cli.progress import Meter

if TYPE_CHECKING:
    from cnpgen.training.checkpoint import State
    from cnpgen.training.train import Trained
    from cnpgen.training.training_run import Run


LINE_WIDTH = 100  # of a line
OFTEN = 100  # passes over the same rows after which more rows help more


class Watch:
    """Shows how training goes."""

    def __init__(self, *, quiet: bool) -> None:
        self._meter, self._quiet = Meter(quiet=quiet, noun="step"), quiet
        self._last = 0
        self._seen: Mapping[str, Any] = {}

    def begin(self, state: "State", run: "Run") -> None:
        """Say what begins."""
        step, steps = state.adam.step, state.steps
        self._last = step
        parameters = run.learner.architecture.n_parameters
        self._meter.begin(f"training {parameters:,} parameters on {len(run.rows):,} rows", steps, step)
        wanted, taken = run.learner.settings.batch_size, run.order.batch_size
        if taken < wanted and not self._quiet:
            print(f"every step takes all {taken:,} rows: there are no {wanted:,} for a batch", file=sys.stderr)
        passes = steps * taken / len(run.rows)
        if passes > OFTEN and not self._quiet:
            print(f"every row is seen {passes:,.0f} times: a planner from more rows is better", file=sys.stderr)

    def __call__(self, record: Mapping[str, Any]) -> None:
        """Show a line of the log."""
        step = record["step"]
        self._meter(step - self._last)
        self._last = step
        for name in ("imitation", "loss"):
            if name in record:
                self._meter.note(f"{name} {record[name]:.4g}")
        if "loss" in record:
            self._seen = record
        if "validation" in record and not self._quiet:
            text = _fitted(f"step {step:,}, {record['seconds']:.0f} s: {_words(record['validation'])}")
            print("\n".join([text, *([_terms(self._seen)] if self._seen else [])]), file=sys.stderr, flush=True)

    def close(self) -> None:
        """Remove the bar."""
        self._meter.close()


def _words(found: Mapping[str, Any]) -> str:
    text = f"{found['valid']:.1%} of {found['plans']:,} plans valid, {found['duration_s']:.3f} s"
    if "z_error_mm_s" in found:
        text += f", z error {found['z_error_mm_s']:.3f} mm s"
    if "vertical_error_rad_s" in found:
        text += f", vertical error {found['vertical_error_rad_s']:.4f} rad s"
    broken = sorted(found["broken"].items(), key=lambda item: -item[1])[:3]
    return text + (f"; broken: {', '.join(f'{name} {count}' for name, count in broken)}" if broken else "")


def _terms(record: Mapping[str, Any]) -> str:
    """Say how large the terms are, as multiples of their budgets where they have one, and their weights."""
    words = []
    for name, weight in record["weights"].items():
        value, budget = record["terms"][name], record["budgets"][name]
        amount = f"{value / budget:.2g}" if budget else f"({value:.2g})"
        words.append(f"{name} {amount} x {weight:.2g}")
    head = f"loss {record['loss']:.4g}, learning rate {record['learning_rate']:.2g}; terms / budgets x weights: "
    return _fitted("  " + head + ", ".join(words))


def summary(trained: "Trained") -> str:
    """Say in a line what came of a run."""
    training = trained.model.training
    steps, best, words = f"{training['steps']:,} steps", f"{training['best_step']:,}", _words(trained.score)
    if not trained.made:
        return _fitted(f"already trained: {steps}, of which that of step {best}: {words}")
    return _fitted(
        f"trained {steps} in {training['cpu_seconds']:.0f} s of CPU time and"
        f" {training['validation_cpu_seconds']:.0f} s for validations; this run took {trained.times};"
        f" the model of step {best} is kept: {words}"
    )


def _fitted(text: str) -> str:
    """Wrap a line to ``LINE_WIDTH``."""
    return "\n".join(textwrap.wrap(text, LINE_WIDTH, subsequent_indent="    ", break_on_hyphens=False))
