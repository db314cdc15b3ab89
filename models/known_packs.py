"""Packs that many people use: what is in them, how large they are, and who may use them.

Licences and sizes are those that the owners state; no address is kept here, since Veilface cannot
vouch for what one serves.
"""

from typing import NamedTuple

_RESEARCH = "non-commercial research only (InsightFace)"
_APACHE = "Apache-2.0"


class KnownPack(NamedTuple):
    """What is known of a pack before it is fetched."""

    contents: str
    licence: str


KNOWN_PACKS = {
    "buffalo_l": KnownPack("SCRFD-10G, ResNet-50 on WebFace600K (512), 289 MB", _RESEARCH),
    "buffalo_m": KnownPack("SCRFD-2.5G, ResNet-50 on WebFace600K (512), 276 MB", _RESEARCH),
    "buffalo_s": KnownPack("SCRFD-500M, MobileFaceNet on WebFace600K (512), 128 MB", _RESEARCH),
    "buffalo_sc": KnownPack("SCRFD-500M, MobileFaceNet on WebFace600K (512), 15 MB", _RESEARCH),
    "antelopev2": KnownPack("SCRFD-10G, ResNet-100 on Glint360K (512), 361 MB", _RESEARCH),
    "sface": KnownPack("SFace of OpenCV Zoo (128), 39 MB, to be used with YuNet (MIT)", _APACHE),
    "auraface": KnownPack("AuraFace of fal: SCRFD-10G, ResNet-100 (512), 278 MB", _APACHE),
}
"""By name, in lower case."""
