"""Bring-up of a freshly wired node: every part is asked, tested and judged (`relpos node check`).

The firmware carries out single transactions of its bus on command; what is asked and how answers
are judged stands here. Figures that nobody has measured on real boards yet are kept for a report.
"""

from relpos.nodes.bringup.check import NodeCheck
from relpos.nodes.bringup.finding import Finding

__all__ = ["Finding", "NodeCheck"]
