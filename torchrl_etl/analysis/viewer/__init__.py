"""A viewer in the browser for a body, moved by its policies or by sliders for its synergies.

Import ``Page``, which needs viser, from ``torchrl_etl.analysis.viewer.page``. A session works
without viser.
"""

from torchrl_etl.analysis.viewer.session import Driver, Session, Subject

__all__ = ["Driver", "Session", "Subject"]
