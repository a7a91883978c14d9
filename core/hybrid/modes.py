"""What paths bring to a hybrid picture, by name."""

from __future__ import annotations

MODES = ("path", "diffuse-1", "reflections", "none")
