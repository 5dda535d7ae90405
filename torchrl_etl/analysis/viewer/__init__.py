"""A body in the browser: its synergies under sliders, its policies at work.

``Page`` needs viser and is imported from ``torchrl_etl.analysis.viewer.page``; a session does
without.
"""

from torchrl_etl.analysis.viewer.session import Driver, Session, Subject

__all__ = ["Driver", "Session", "Subject"]
