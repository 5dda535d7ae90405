"""MyoSuite's environments, and Hand Pose with the hand of MyoSuite 2."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import gymnasium as gym

from torchrl_etl.extras import extra

__all__ = ["register_myosuite"]

_RECIPE = "torchrl_etl_hand"
_HAND_POSE = {
    "torchrl_etl/Myo2HandPoseFixed-v0": "myoHandPoseFixed-v0",
    "torchrl_etl/Myo2HandPoseRandom-v0": "myoHandPoseRandom-v0",
}


def register_myosuite() -> None:
    """Registers MyoSuite's environments, and Hand Pose with the hand of MyoSuite 2.

    MyoSuite 3 changed the hand of Hand Pose: its fingers pass through each other, and the first
    two axes of its thumb are swapped. Key Turn and Pen Twirl kept the old hand. Hand Pose here
    uses Key Turn's hand without the key. With the fixed goal, observations, rewards and contacts
    equal those of MyoSuite 2.5 and 2.12. Targets are not rendered.
    """
    with extra("myosuite"):
        import myosuite  # noqa: F401  (importing it registers its environments)
    from myosuite.core.model_builder import get_recipe, list_recipes, model_recipe

    if _RECIPE in list_recipes():
        return

    @model_recipe(_RECIPE)
    def hand(builder: Any) -> Any:
        return get_recipe("hand_keyturn")(builder).apply_transform(_without_key)

    for env_id, successor in _HAND_POSE.items():
        spec = gym.spec(successor)
        kwargs = spec.kwargs | {"model_recipe": _RECIPE, "viz_site_targets": None}
        if "target_jnt_value" in kwargs:
            kwargs["target_jnt_value"] = _old_order(kwargs["target_jnt_value"])
        else:
            ranges = _old_order(kwargs["target_jnt_range"].items())
            kwargs["target_jnt_range"] = {name.removesuffix("_r"): of for name, of in ranges}
        gym.registry[env_id] = replace(spec, id=env_id, kwargs=kwargs)


def _without_key(spec: Any) -> Any:
    spec.delete(spec.body("key"))
    return spec


def _old_order(joints: Any) -> list[Any]:
    """Puts the thumb's abduction before its flexion."""
    joints = list(joints)
    joints[3], joints[4] = joints[4], joints[3]
    return joints
