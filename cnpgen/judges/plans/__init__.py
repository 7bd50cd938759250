"""The verdict: plans checked with Pinocchio and Coal at every moment, and what is counted and shown of it."""

from cnpgen.judges.plans.judge import judge
from cnpgen.judges.plans.summary import summarise
from cnpgen.judges.plans.verdict import Margin, Metrics, PaperRule, Reason, Verdict

__all__ = ["Margin", "Metrics", "PaperRule", "Reason", "Verdict", "judge", "summarise"]
