"""The verdict: plans checked with Pinocchio and Coal on a fine time grid, and what is counted and shown of it."""

from cnpgen.verdict.judge import judge
from cnpgen.verdict.summary import summarise
from cnpgen.verdict.verdict import Margin, Metrics, PaperRule, Reason, Verdict

__all__ = ["Margin", "Metrics", "PaperRule", "Reason", "Verdict", "judge", "summarise"]
