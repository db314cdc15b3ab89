"""What a subject that does not exist is decided against, so that its answer looks like any other.

A keyed digest of the subject seeds the lifting of a face of nobody with fresh decoys, as a real
person was lifted with fresh decoys, so that

- the same unknown subject always gives the same distances, as an enrolled one does;
- two unknown subjects give different distances: equal ones would tell that both are unknown;
- the distances are those of impostors, each alone and several together: no two stand-ins share a
  decoy, whose sampling error a patient attacker could learn (docs/threat-model.md).
"""

from dataclasses import dataclass, field

from templates.contract.nobody import Nobody
from templates.keys.randomness import Keystream
from templates.space.subspace import AffineSubspace


@dataclass(frozen=True)
class StandIn:
    """A template of nobody for one unknown subject.

    Attributes
    ----------
    wire
        Wire bytes of some template of nobody: decoding them is work that a real one would cost.
    lifted
        The subject's own, of :func:`lift_stand_in`, where the distance will be told; ``wire``
        serves where it will not.
    template_id
        Any, as long as a real one: a rotation is derived from it, as from a real one.
    holder_salt
        None: no key would be the holder's.
    """

    wire: bytes = field(repr=False)
    lifted: AffineSubspace | None = field(default=None, repr=False)
    template_id: str = "0" * 32
    holder_salt: str | None = None


def lift_stand_in(nobody: Nobody, digest: bytes) -> AffineSubspace:
    """Lift the template of a stand-in.

    Parameters
    ----------
    digest
        32 bytes that only the deployment can compute, and that name the subject: with them, a
        distance would tell an unknown subject.

    Notes
    -----
    It is in *no* rotation: the distance of a probe to it is the one that both would
    have when turned.
    """
    if len(digest) != 32:
        raise ValueError(f"a digest has 32 bytes, this has {len(digest)}")
    with Keystream(digest) as stream:
        return nobody.lift(stream)
