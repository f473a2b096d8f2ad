"""From what the user has set to a plan; what is missing is said before anything runs."""

from __future__ import annotations

from typing import Any

from . import finding
from .capture import check_garment, weights_of
from .fault import BakeError
from .folders import bake_folder, own_hood
from .meshes import unlike
from .plan import GarmentPlan, Plan
from .preferences import preference
from .properties import folder_name, frames_of

#: Frames of an estimate.
_FEW = 6


def plan_of(context: Any, estimate: bool = False, again: bool = False) -> Plan:
    """The plan of the bake of a scene.

    Raises:
        BakeError: something is missing or cannot be used; names it and says what to do.
    """
    scene = context.scene
    settings = scene.hood
    first, last = frames_of(scene)
    if not len(settings.garments):
        raise BakeError("no garment is in the list; select one and press Add")
    if last <= first:
        raise BakeError(f"the range from frame {first} to {last} is empty; give a last frame after the first")
    body = settings.body
    if body is None:
        raise BakeError("no body is chosen; choose the object that wears the garments")
    if scene.objects.get(body.name) is None:
        raise BakeError(f"body {body.name}: is not in this scene any more; link it again, or choose another")
    if body.mode == "EDIT":
        raise BakeError(f"body {body.name}: is in edit mode; leave it (Tab)")
    garments = _garments(scene, settings, body)
    name = folder_name(scene) + ("_estimate" if estimate else "")
    return Plan(
        scene=scene.name,
        layer=context.view_layer.name,
        folder=bake_folder(name),
        hood=finding.find_hood(preference("program"), own_hood()),
        body=body.name,
        body_uid=body.session_uid,
        garments=garments,
        first=first,
        last=min(last, first + _FEW - 1) if estimate else last,
        quality=settings.quality,
        keys=settings.result == "KEYS",
        halves=settings.halves,
        threads=settings.threads,
        more=tuple(settings.more.split()),
        again=again,
        estimate=estimate,
    )


def _garments(scene: Any, settings: Any, body: Any) -> list[GarmentPlan]:
    objects = [garment.object for garment in settings.garments]
    for place, one in enumerate(objects, 1):
        if one is None or scene.objects.get(one.name) is None:
            raise BakeError(f"garment {place} of the list is not in this scene any more; take it out of the list")
        if one == body:
            raise BakeError(f"{one.name}: is the body and a garment; take it out of the list", one.name)
        if objects.index(one) != place - 1:
            raise BakeError(f"{one.name}: is in the list twice; take one of them out", one.name)
        check_garment(one)
    files, found = unlike([one.name for one in objects]), []
    for garment, one, file in zip(settings.garments, objects, files, strict=True):
        if garment.pins:
            weights_of(one, garment.pins)
        if garment.follows and body.vertex_groups.get(garment.follows) is None:
            weights_of(body, garment.follows)
        slots: tuple[str, ...] = ()
        if garment.by_slot and len(one.material_slots) > 1:
            own = [slot.fabric for slot in garment.slots]
            slots = tuple(own[k] if k < len(own) else garment.fabric for k in range(len(one.material_slots)))
        found.append(
            GarmentPlan(one.name, one.session_uid, file, garment.fabric, slots, garment.pins, garment.follows, garment.sew)
        )
    return found
