"""The examples of docs/contributing.md run as they are."""

from __future__ import annotations

import re
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

import lipac
from lipac.core.culling.policies import POLICIES
from lipac.core.scene.model import RayType
from lipac.lipac_addon.extract.materials import nodes
from lipac.lipac_addon.extract.materials.reader import Reader, Value, View

from .core.culling.test_loop import CASTER, FLOOR, MIRROR, SEEN, stage
from .lipac_addon.conftest import boxes  # noqa: F401

EXAMPLES = re.findall(
    r"```python\n(.*?)```", (Path(lipac.__file__).parent / "docs" / "contributing.md").read_text(), re.DOTALL
)


def test_a_policy() -> None:
    module = ModuleType("lipac.core.culling.policies.height")
    module.__package__ = "lipac.core.culling.policies"
    exec(EXAMPLES[0], vars(module))
    policy = module.POLICY
    assert policy.rank not in {other.rank for other in POLICIES.values()}
    scene = stage()
    lowest = scene.instances.bounds[:, 0, 2].min()
    keep = policy.keep(scene, -lowest + 2.0)
    assert keep[[FLOOR, SEEN, MIRROR, CASTER]].tolist() == [False, False, True, True]
    counts = [int(policy.keep(scene, x).sum()) for x in policy.setting.ladder(scene)]
    assert counts == sorted(counts)
    assert counts[0] < counts[-1]


def test_a_node(boxes: Any, monkeypatch: pytest.MonkeyPatch) -> None:  # noqa: F811
    import bpy

    namespace: dict[str, Any] = {"np": np, "Any": Any, "Value": Value, "Reader": Reader}
    exec(EXAMPLES[1], namespace)
    tree = bpy.data.materials.new("m")
    tree.use_nodes = True
    node = tree.node_tree.nodes.new("ShaderNodeFloatCurve")
    node.mapping.curves[0].points[0].location = (0.0, 1.0)  # a straight line from 1 to 1
    node.inputs["Factor"].default_value, node.inputs["Value"].default_value = 0.5, 0.2
    target = tree.node_tree.nodes["Principled BSDF"].inputs["Roughness"]
    tree.node_tree.links.new(node.outputs[0], target)
    lines: list[str] = []

    def read() -> float:
        reader = Reader(None, lines.append, View(RayType.CAMERA, False), nodes)  # type: ignore[arg-type]
        return reader.value(target).scalar

    read()
    assert lines == ["Float Curve node replaced by a constant"]  # not followed yet: else the page needs another example
    monkeypatch.setattr(nodes, "node_curve_float", namespace["node_curve_float"], raising=False)
    assert read() == pytest.approx(0.6, abs=1e-3)
    assert len(lines) == 1
