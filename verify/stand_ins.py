"""What a subject that does not exist is decided against, so that its answer looks like any other.

The contract's cohort holds templates of nobody, lifted as real ones are. A keyed digest of the
subject picks one of them and mirrors it in a direction between two others, so that

- the same unknown subject always gives the same distances, as an enrolled one does;
- two unknown subjects give different distances, although the cohort has fewer members than there
  are subjects: equal ones would tell that both are unknown;
- the distances are those of impostors, because a mirror image of a template, in a direction in
  which templates lie, is about as far from faces as the template.
"""

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from templates.subspace import AffineSubspace, SubspaceBatch


@dataclass(frozen=True, eq=False)
class StandIn:
    """A template of nobody for one unknown subject.

    Attributes
    ----------
    wire
        Wire bytes of a member of the cohort. It is *not* in the tenant's rotation: the distance of
        a probe to it is the one that both would have when turned.
    mirror : (n,) float32
        Unit normal of the hyperplane through the origin in which the template is mirrored.
    """

    wire: bytes = field(repr=False)
    mirror: NDArray[np.float32] = field(repr=False)

    def mirrored(self, template: AffineSubspace) -> AffineSubspace:
        """Mirror the decoded template: v - 2 (v·u) u for its foot point and every basis row."""
        u = self.mirror
        return AffineSubspace(
            template.foot - 2 * (template.foot @ u) * u,
            template.basis - 2 * np.outer(template.basis @ u, u),
        )


def pick_stand_in(cohort: SubspaceBatch, digest: bytes) -> tuple[int, NDArray[np.float32]]:
    """Choose a member of the cohort and a mirror by a digest.

    Parameters
    ----------
    cohort
        The contract's, un-rotated.
    digest
        32 bytes that only the deployment can compute: with the digest, and the cohort, a distance
        would tell an unknown subject.

    Returns
    -------
    index : int
        Of the member.
    mirror : (n,) float32
        A unit vector in the plane of the first basis rows of two members.
    """
    if len(digest) != 32:
        raise ValueError(f"a digest has 32 bytes, this has {len(digest)}")
    words = [int.from_bytes(digest[at : at + 8], "big") for at in range(0, 32, 8)]
    size = len(cohort)
    first = words[1] % size
    second = (first + 1 + words[2] % max(1, size - 1)) % size
    angle = 2 * math.pi * words[3] / 2**64
    direction = math.cos(angle) * cohort.bases[first, 0].astype(np.float64)
    direction += math.sin(angle) * cohort.bases[second, 0]
    return words[0] % size, (direction / np.linalg.norm(direction)).astype(np.float32)
