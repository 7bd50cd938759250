"""A training run: steps, log, validation, checkpoints, and selection of the best model."""

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from cnpgen.arrays import AnyArray
from cnpgen.documents import JsonMapping, JsonObject
from cnpgen.errors import MachineError
from cnpgen.losses.metric import Metric
from cnpgen.losses.plan_loss import PlanLoss
from cnpgen.losses.quadrature import rotating_shift
from cnpgen.machine.signals import signals_deferred
from cnpgen.planner.model import Model
from cnpgen.training.adam import learning_rate
from cnpgen.training.checkpoint import Best, Checkpoints, State, Sums
from cnpgen.training.log import TrainingLog
from cnpgen.training.step import Learner
from cnpgen.training.training_rows import Rows, StepRows

Watcher = Callable[[JsonMapping], None]

LOG_LINES = 100  # per run
# Between the shifts of successive steps; coprime to the number of shifts.
SHIFT_STRIDE = 7


@dataclass
class Run:
    """One run.

    ``loss`` has the terms and their acceptable values, from the problem file.
    ``metric`` has the weights of the constraint terms. ``model`` makes a model of
    parameters. ``validate`` scores it: a record for the log with a ``score``, the
    larger the better. Without ``initial_parameters``, they are random. ``order`` is the
    order of the rows.
    """

    learner: Learner
    loss: PlanLoss
    rows: Rows
    metric: Metric
    model: Callable[[AnyArray], Model]
    validate: Callable[[Model], JsonMapping]
    initial_parameters: AnyArray | None = None

    def __post_init__(self) -> None:
        settings = self.learner.settings
        self.order = StepRows(len(self.rows), settings.batch_size, settings.seed)

    def train(
        self,
        state: State,
        checkpoints: Checkpoints,
        log: TrainingLog,
        watch: Watcher | None = None,
    ) -> None:
        """Train until the last step; the state is changed in place, and ``watch`` is called with every line of the log.

        Raise MachineError if the loss is not finite any more, or the disk is full.
        """
        if state.metric:
            self.metric.load_state(state.metric)
        gradient = np.empty_like(state.adam.parameters)
        while state.adam.step < state.steps:
            # A signal ends the loop between two steps, with a checkpoint of a
            # consistent state.
            with signals_deferred() as waiting:
                while state.adam.step < state.steps and not waiting.came:
                    self._train_step(state, gradient, log, watch)
                    checkpoints.save_if_due(state)
                if waiting.came:
                    checkpoints.save(state)

    def _train_step(
        self, state: State, gradient: AnyArray, log: TrainingLog, watch: Watcher | None
    ) -> None:
        """Take a step, and write the records that are due after it."""
        started = time.process_time()
        self.step(state, gradient)
        state.seconds += time.process_time() - started
        for record in self._due(state):
            log.write(record)
            if watch is not None:
                watch(record)

    def step(self, state: State, gradient: AnyArray) -> None:
        """Take one step; ``gradient`` is a buffer of shape (n_parameters,)."""
        adam = state.adam
        step = state.adam.step
        rows = self.rows.take(self.order.batch(step))
        if step < state.imitating:
            distances = self.learner.imitation_gradient(
                adam.parameters, rows, clipping=state.clipping, out=gradient
            )
            state.sums.add_distances(distances)
        else:
            self._gradient(state, rows, gradient)
        self.learner.update(
            adam, state.clipping, gradient, rate=self._rate(state, step)
        )

    def _gradient(self, state: State, rows: Rows, gradient: AnyArray) -> None:
        """Write the gradient of the loss, and pass the terms of the batch to the metric."""
        progress = state.progress(state.adam.step)
        terms = self.learner.gradient(
            state.adam.parameters,
            rows,
            self.metric.weights(progress),
            shift=rotating_shift(
                state.adam.step * SHIFT_STRIDE, self.learner.settings.shifts
            ),
            clipping=state.clipping,
            out=gradient,
        )
        self.metric.observe(terms, progress)
        # The step is counted by the optimizer, after the gradient.
        if (state.adam.step + 1) % self.order.batches == 0:
            self.metric.end_epoch(progress)
        state.metric = self.metric.state()
        state.sums.add(terms)

    def _rate(self, state: State, step: int) -> float:
        settings = self.learner.settings
        return learning_rate(
            step,
            state.steps,
            peak=settings.learning_rate,
            final=settings.final_rate,
            warm_up=settings.warm_up,
        )

    def _due(self, state: State) -> list[JsonObject]:
        """Return the records of the log that are due after this step."""
        step = state.adam.step
        records = []
        if _is_due(step, state.steps, LOG_LINES):
            records.append(self._progress(state))
        if _is_due(step, state.steps, self.learner.settings.validations):
            records.append(self._check(state))
        return records

    def _progress(self, state: State) -> JsonObject:
        """Return the means of the terms since the last line."""
        sums = state.sums
        step = state.adam.step
        state.sums = Sums(np.zeros_like(sums.terms))
        # The run diverges if more than half of the plans have no finite loss.
        if sums.lost > sums.steps * self.order.batch_size // 2:
            raise MachineError(
                f"the loss of most plans is not finite at step {step}: try a smaller {{learning_rate}}",
                remedies={"learning_rate": None},
            )
        return {
            "step": step,
            "epoch": round(step / self.order.batches, 3),
            "learning_rate": self._rate(state, step - 1),
            "seconds": round(state.seconds, 2),
            **({"imitation": sums.distance / sums.imitating} if sums.imitating else {}),
            **(self._means(state, sums) if sums.steps else {}),
            "lost": sums.lost,
        }

    def _means(self, state: State, sums: Sums) -> JsonObject:
        means = sums.terms / sums.steps
        # The first term is that of the task.
        constraints = self.loss.terms[1:]
        weights = self.metric.weights(state.progress(state.adam.step - 1))
        return {
            # L = task loss + sum of weight times constraint term
            "loss": float(means[0] + means[1:] @ weights),
            "terms": dict(zip(self.loss.terms, means.tolist(), strict=True)),
            "weights": dict(zip(constraints, weights.tolist(), strict=True)),
            "budgets": dict(zip(constraints, self.loss.budgets.tolist(), strict=True)),
        }

    def _check(self, state: State) -> JsonObject:
        """Validate the averaged parameters; keep them if they are the best so far."""
        started = time.process_time()
        step = state.adam.step
        record = self.validate(self.model(state.adam.average))
        if self.learner.settings.keep == "last" or record["score"] >= state.best.score:
            state.best = Best(record["score"], step, state.adam.average.copy())
        state.checking += time.process_time() - started
        return {
            "step": step,
            "seconds": round(state.seconds, 2),
            "validation": dict(record),
        }


def _is_due(step: int, steps: int, times: int) -> bool:
    """Return whether an event that happens ``times`` times per run is due after this step."""
    # Events are spread evenly: floor(step times / steps) rises by one at each.
    return step * times // steps > (step - 1) * times // steps
