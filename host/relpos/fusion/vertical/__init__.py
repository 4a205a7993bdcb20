"""The third dimension: heights, episodes (stairs, lifts, disturbed pressure) and floors.

Begin reading at ``filter``: estimators own a :class:`~relpos.fusion.vertical.filter.VerticalFilter`
beside their filter of the plane. ``episodes`` says what a node's wearer is doing, ``heights`` how
high everybody is, ``floors`` on which floor. docs/building.md has the reasons and the figures.
"""
