"""Attacks that train networks on faces of the attacker: needs the ``torch`` extra.

Nothing here imports torch before an attack is made.
"""

from attacks.learned.crops import FaceCrops
from attacks.learned.decoder import Decoder, train_decoder
from attacks.learned.inverter import Inverter, invert, train
from attacks.learned.reconstruction import Reconstruction, reconstruct, score_images

__all__ = [
    "Decoder",
    "FaceCrops",
    "Inverter",
    "Reconstruction",
    "invert",
    "reconstruct",
    "score_images",
    "train",
    "train_decoder",
]
