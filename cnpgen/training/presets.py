"""Presets: named training settings, which options given explicitly override."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from cnpgen.losses.metric import PUBLISHED
from cnpgen.training.settings import Length, TrainingSettings


@dataclass(frozen=True)
class Preset:
    """Training settings with a suitable length of a run."""

    settings: TrainingSettings
    length: Length


PAPER = Preset(
    TrainingSettings(
        hidden=2048,  # authors' implementation; the paper has no widths
        layers=5,
        batch_size=128,  # Appendix B, parameters
        learning_rate=5e-5,  # Appendix B, parameters
        final_rate=1.0,
        warm_up=0,
        path_scale=math.pi,  # equation of the inner control points
        head_scale=1.0,
        rate_bias=0.0,
        line_projection_steps=0,
        projection_steps=0,
        nodes=64,
        shifts=8,
        sample_clip=math.inf,
        batch_clip=math.inf,
        memory=0.0,
        metric=PUBLISHED,  # section on loss function learning; gamma of Appendix B
        expected_time="travel",
        usual_margins=False,
        features="paper",
        loss_form="paper",
        constraint_terms="budgeted",
        time_varying_bounds=False,
        path_control_points=15,  # Appendix B, parameters
        rate_control_points=20,
        keep="last",
        validations=50,
    ),
    Length(epochs=1300),
)
PRESETS: Mapping[str, Preset] = {"paper": PAPER}
