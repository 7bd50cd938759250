"""Verdicts: plans checked with Pinocchio and Coal over the whole motion, their summaries and plots."""

from cnpgen.judges.plans.judge import judge
from cnpgen.judges.plans.verdict import (
    Margin,
    Metrics,
    PaperRule,
    Reason,
    Verdict,
    summarize_verdicts,
)

__all__ = [
    "Margin",
    "Metrics",
    "PaperRule",
    "Reason",
    "Verdict",
    "judge",
    "summarize_verdicts",
]
