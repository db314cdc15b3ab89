"""Small folders that audits run on, and what the documentation says of their reports."""

import re
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
from PIL import Image

from models.synthetic import draw_face, draw_person, encode_photo
from verify.fairface_labels import RACES

TRAIN, VALIDATION = 260, 60
AGES = ("03-Sep", "20-29", "Oct-19", "more than 70")
"""Two of them as spreadsheets leave them."""


def write_photo(file: Path, identity: int, photo: int = 0) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(encode_photo(draw_face(identity, photo)))


def gender_of(identity: int) -> str:
    """A label that the picture shows, so that an attacker can learn it: light or dark skin."""
    return "Female" if draw_person(identity).skin < 0.5 else "Male"


def draw_fairface(root: Path, *, train: int = TRAIN, validation: int = VALIDATION) -> Path:
    """Write a folder as FairFace is; gender is seen in the pictures, race and age are not."""
    for part, first, count in (("train", 9000, train), ("val", 9500, validation)):
        lines = ["file,age,gender,race,service_test"]
        for number in range(count):
            write_photo(root / part / f"{number}.png", first + number)
            age, race = AGES[number % len(AGES)], RACES[number % 3]
            lines.append(f"{part}/{number}.png,{age},{gender_of(first + number)},{race},FALSE")
        (root / f"fairface_label_{part}.csv").write_text("\n".join(lines) + "\n")
    return root


def draw_people(root: Path, labelled: Path, *, several: int, single: int) -> Path:
    """Write a folder of people: those of ``labelled`` and more, with two photos and with one."""
    for person in sorted(labelled.iterdir()):
        (root / person.name).mkdir(parents=True)
        for file in sorted(person.iterdir()):
            (root / person.name / file.name).symlink_to(file.resolve())
    for number in range(several + single):
        for photo in range(2 if number < several else 1):
            write_photo(root / f"drawn-{number:03d}" / f"{photo}.png", 20_000 + number, photo)
    return root


DOCS = Path(__file__).resolve().parents[3] / "docs" / "formats.md"


def section() -> str:
    text = DOCS.read_text(encoding="utf-8")
    return re.split(r"\n#", text.split("### `report.json` of an audit", 1)[1], maxsplit=1)[0]


def documented() -> dict[str, str]:
    """Members of the report in the documentation's table, with what is said of them."""
    members: dict[str, str] = {}
    for line in section().splitlines():
        if line.startswith("| `"):
            names, said = line.strip("| ").split(" | ", 1)
            members |= dict.fromkeys(re.findall(r"`(\w+)`", names), said)
    return members


def named_in(start: str) -> set[str]:
    """Names in the paragraph of the documentation that starts so."""
    (paragraph,) = [part for part in section().split("\n\n") if part.strip().startswith(start)]
    return set(re.findall(r"`(\w+)`", paragraph))


def are_pictures(folder: Path, names: list[str]) -> None:
    for name in names:
        with Image.open(folder / f"{name}.png") as picture:
            assert min(picture.size) > 300
            assert len(set(np.asarray(picture.convert("L")).ravel().tolist())) > 10
        assert ET.parse(folder / f"{name}.svg").getroot().tag.endswith("svg")


def both(names: list[str]) -> list[str]:
    return [f"{name}.{end}" for name in names for end in ("png", "svg")]
