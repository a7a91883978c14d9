"""What light paths need: decided by the loop (`core.culling.analysis`), not by a rule."""

from __future__ import annotations

from .policy import Policy

_TEXT = "Keep what light paths meet: what is seen, reflected, what casts shadows or light into the picture"
POLICY = Policy("light-paths", "Light paths", _TEXT, 0)
