"""Policies: what decides which instances stay. A module here is a policy; commands, panel and evaluation find it by
itself.

A policy is a module with a `POLICY`, on the base of `policy`; it may use scene and camera, and loads no kernels: the
panel lists policies before any is compiled. See docs/contributing.md.
"""

from __future__ import annotations

from importlib import import_module
from pkgutil import iter_modules

from .policy import Policy, Setting

__all__ = ["LIGHT_PATHS", "NOTHING", "POLICIES", "RULES", "Policy", "Setting"]

_FOUND = (getattr(import_module(f".{module.name}", __name__), "POLICY", None) for module in iter_modules(__path__))
# All, by name, in the order of their ranks
POLICIES: dict[str, Policy] = {
    policy.name: policy for policy in sorted((p for p in _FOUND if p), key=lambda p: (p.rank, p.name))
}
# Those that keep what fits a rule by a setting
RULES = {name: policy for name, policy in POLICIES.items() if policy.setting is not None}
NOTHING, LIGHT_PATHS = "none", "light-paths"
