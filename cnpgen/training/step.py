"""One training step: batch, network, loss, gradient, parameters."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from cnpgen.arrays import AnyArray
from cnpgen.losses.plan_loss import LossValue
from cnpgen.planner.control_points import ControlPoints, Projection, control_points, vjp
from cnpgen.planner.network.architecture import Architecture, backward, forward
from cnpgen.planner.network.features import Features
from cnpgen.planner.tasks import Tasks
from cnpgen.training.adam import Adam, Clipping
from cnpgen.training.settings import TrainingSettings
from cnpgen.training.training_rows import Rows
from cnpgen.trajectory.trajectory_spec import TrajectorySpec

Loss = Callable[..., LossValue]


def imitation_loss(points: ControlPoints, target: ControlPoints) -> LossValue:
    """Return half the squared distances of path control points [rad^2] and of logarithms of rate control points.

    The distances are ``total`` and the only column of ``terms``.
    """
    # L = (|p - p*|^2 + |log r - log r*|^2) / 2; dL/dp = p - p*, dL/dr = log(r / r*) /
    # r.
    by_path = points.path - target.path
    logs = np.log(points.rate / target.rate)
    total = 0.5 * (
        np.einsum("ijk,ijk->i", by_path, by_path) + np.einsum("ij,ij->i", logs, logs)
    )
    return LossValue(total, total[:, None], by_path, logs / points.rate)


@dataclass(frozen=True)
class Learner:
    """Constants of a training step.

    The projection leads the network's paths onto the equalities, if there are any.
    ``along`` returns tasks along the paths of plans for them, whose features are
    defined by ``features``.
    """

    architecture: Architecture
    spec: TrajectorySpec
    loss: Loss
    settings: TrainingSettings
    projection: Projection | None = None
    along: Callable[[Tasks, AnyArray], Tasks] | None = None
    features: Features | None = None

    def gradient(
        self,
        parameters: AnyArray,
        rows: Rows,
        weights: AnyArray,
        *,
        shift: float,
        clipping: Clipping,
        out: AnyArray,
    ) -> AnyArray:
        """Write the gradient of the mean loss of a batch with respect to all parameters, shape (n_parameters,).

        The constraint terms have weights of shape (m,); the quadrature nodes have a
        shift in [0, 1). Return the terms of every sample, shape (N, 1 + m).
        """

        def cost(rows: Rows, points: ControlPoints) -> LossValue:
            start_tip = (
                rows.tasks.start_xyz if self.settings.time_varying_bounds else None
            )
            return self.loss(
                points.path,
                points.rate,
                weights=weights,
                obstacle_poses=rows.tasks.obstacle_poses,
                start_tip=start_tip,
                shift=shift,
            )

        return self._gradient(parameters, rows, cost, clipping, out)

    def imitation_gradient(
        self, parameters: AnyArray, rows: Rows, *, clipping: Clipping, out: AnyArray
    ) -> AnyArray:
        """Write the gradient of the mean distance from demonstrations.

        Return the distances, shape (N, 1).
        """
        target = rows.target
        assert target is not None
        return self._gradient(
            parameters,
            rows,
            lambda _, points: imitation_loss(points, target),
            clipping,
            out,
        )

    def _gradient(
        self,
        parameters: AnyArray,
        rows: Rows,
        cost: Callable[[Rows, ControlPoints], LossValue],
        clipping: Clipping,
        out: AnyArray,
    ) -> AnyArray:
        network = self.architecture.split(parameters)
        scale = self.settings.path_scale
        part = out
        for iteration in range(self.settings.iterations):
            activations = forward(network, rows.features)
            outputs = activations.path, activations.log_rate
            points = control_points(rows.tasks, *outputs, scale=scale, spec=self.spec)
            projected = self._projected(points, rows)
            value = cost(rows, projected)
            phi, log_rate = self._output_gradients(rows, points, value)
            factors = self._factors(phi, log_rate, clipping)
            # The factor of a sample scales both heads: the direction of its gradient
            # stays.
            phi *= factors
            log_rate *= factors
            gradients = self.architecture.split(part)
            backward(
                network,
                activations,
                path_gradient=phi,
                log_rate_gradient=log_rate,
                out=gradients,
            )
            # The loss is the sum over the evaluations of the network, each with its own
            # line.
            if iteration:
                out += part
            if iteration + 1 < self.settings.iterations:
                part = np.empty_like(out) if iteration == 0 else part
                rows = self._along(rows, projected.path)
        return value.terms

    def _along(self, rows: Rows, path: AnyArray) -> Rows:
        """Return the rows of the next iteration, whose lines are the paths of this one."""
        assert self.along is not None
        assert self.features is not None
        tasks = self.along(rows.tasks, path)
        return replace(
            rows,
            # The observation is part of the features.
            tasks=replace(tasks, observation=None),
            features=self.features.of(tasks),
        )

    def _output_gradients(
        self, rows: Rows, points: ControlPoints, value: LossValue
    ) -> tuple[AnyArray, AnyArray]:
        """Return the loss's gradients with respect to both heads."""
        by_path, by_rate = (
            gradient.astype(points.path.dtype, copy=False)
            for gradient in (value.path_gradient, value.rate_gradient)
        )
        if self.projection is not None:
            # The gradient is carried back through the projection: g^T dP/dp.
            by_path = self.projection.vjp(points.path, rows.tasks.scene.poses, by_path)
        scale = self.settings.path_scale
        return vjp(
            rows.tasks,
            points,
            path_gradient=by_path,
            rate_gradient=by_rate,
            scale=scale,
            spec=self.spec,
        )

    def _projected(self, points: ControlPoints, rows: Rows) -> ControlPoints:
        if self.projection is None:
            return points
        return ControlPoints(
            self.projection.project(points.path, rows.tasks.scene.poses), points.rate
        )

    def _factors(
        self, phi: AnyArray, log_rate: AnyArray, clipping: Clipping
    ) -> AnyArray:
        """Return the factors of the samples' gradients, shape (N, 1).

        A gradient that is not finite becomes 0.
        """
        norms = np.sqrt(
            np.einsum("ij,ij->i", phi, phi) + np.einsum("ij,ij->i", log_rate, log_rate)
        )
        usable = np.isfinite(norms)
        if not usable.all():
            # Samples without a finite gradient take no part in the step.
            phi[~usable] = 0
            log_rate[~usable] = 0
            norms = np.where(usable, norms, 0)
        factors = clipping.sample_factors(norms, limit=self.settings.sample_clip)
        # The mean over the batch.
        return (factors / len(factors))[:, None]

    def update(
        self, adam: Adam, clipping: Clipping, gradient: AnyArray, *, rate: float
    ) -> None:
        """Clip the gradient of a batch and take an Adam step.

        One that is not finite only increments the step count.
        """
        norm = float(np.sqrt(np.dot(gradient, gradient)))
        if np.isfinite(norm):
            gradient *= clipping.batch_factor(norm, limit=self.settings.batch_clip)
            adam.update(gradient, rate=rate, memory=self.settings.memory)
        else:
            # The step counts, so that batches and learning rates go on.
            adam.step += 1
