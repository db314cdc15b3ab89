"""Packs that many people use: what is in them, how large they are, and who may use them.

Licences and sizes are those that the owners state; no address is kept here, since Veilface cannot
vouch for what one serves.
"""

from dataclasses import dataclass

_RESEARCH = "non-commercial research only (InsightFace)"
_APACHE = "Apache-2.0"


@dataclass(frozen=True)
class KnownPack:
    """What is known of a pack before it is fetched."""

    contents: str
    licence: str
    megabytes: float


KNOWN_PACKS = {
    "buffalo_l": KnownPack("SCRFD-10G, ResNet-50 on WebFace600K (512)", _RESEARCH, 289),
    "buffalo_m": KnownPack("SCRFD-2.5G, ResNet-50 on WebFace600K (512)", _RESEARCH, 276),
    "buffalo_s": KnownPack("SCRFD-500M, MobileFaceNet on WebFace600K (512)", _RESEARCH, 128),
    "buffalo_sc": KnownPack("SCRFD-500M, MobileFaceNet on WebFace600K (512)", _RESEARCH, 15),
    "antelopev2": KnownPack("SCRFD-10G, ResNet-100 on Glint360K (512)", _RESEARCH, 361),
    "sface": KnownPack(
        "SFace of OpenCV Zoo (128); fetch YuNet beside it (MIT, 0.2 MB)", _APACHE, 39
    ),
    "auraface": KnownPack("AuraFace of fal: SCRFD-10G, ResNet-100 (512)", _APACHE, 278),
}
"""By name, in lower case."""
