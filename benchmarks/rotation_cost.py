"""What the rotations of a template, the tenant's and the holder's, add to one decision.

Templates are enrolled and decided by the service's own classes, in this process and without a
database. In every round the same probe is decided in turn with both rotations, with the tenant's
alone and with none, so that a noisy machine disturbs all alike, and the template is read as the
wire's rules want it and as it was sealed. Figures are of this process's processor time, the median
and the quickest tenth. People are drawn: the time is of no one person.

Example
-------
::

    OMP_NUM_THREADS=1 python -m benchmarks.rotation_cost
"""

import argparse
import json
import time
from collections.abc import Callable
from functools import partial

import numpy as np

from enroll import Enroller, Holder
from templates.contract import wire
from templates.contract.document import Binding
from templates.decoys import DecoyGenerator
from templates.distances import Metric
from templates.keys.randomness import KEY_BYTES, Keystream
from templates.keys.rotation import ROTATION_VERSION, HolderKey, TenantRotation
from templates.space.embedding import normalised
from templates.space.lifting import Strategy
from templates.space.subspace import SubspaceBatch, Turn
from verify import CalibrationOptions, Verifier, calibrate
from verify.expectation import fit_expectation
from verify.verifier import OpenedTemplate

BOTH, TENANT, NONE = "both rotations", "the tenant's", "no rotation"
READ, AS_STORED = "by the rules", "as sealed"


class Unrotated(Verifier):
    """A verifier of templates that are in no rotation."""

    def _opened(
        self,
        stored: OpenedTemplate,
        _key: HolderKey | None,
        *,
        read: Callable[[bytes], wire.WireTemplate],
    ) -> tuple[SubspaceBatch, Turn]:
        return SubspaceBatch.of([read(stored.wire).subspace]), self._turn(stored)

    def _turn(self, _stored: OpenedTemplate) -> Turn:
        return lambda points: points


class TenantOnly(Unrotated):
    """A verifier that derives and applies no holder's rotation."""

    def _turn(self, stored: OpenedTemplate) -> Turn:
        return self._rotation.of(stored.template_id).turned


def main() -> None:
    """Calibrate on drawn people, enroll one, time rounds, print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--n", type=int, default=512)
    parser.add_argument("--dim", type=int, default=160)
    parser.add_argument("--rounds", type=int, default=1000)
    args = parser.parse_args()
    rng = np.random.default_rng(0)
    people = np.repeat(normalised(rng.standard_normal((80, args.n))), 3, axis=0)
    photos = normalised(people + 0.7 * normalised(rng.standard_normal(people.shape)))
    photos = photos.astype(np.float32)
    source = DecoyGenerator.fit(normalised(rng.standard_normal((2000, args.n))).astype(np.float32))
    with Keystream.fresh() as stream:
        expectation = fit_expectation(
            source,
            source,
            strategy=Strategy.ADVERSARIAL,
            m=args.dim,
            metric=Metric.SPHERICAL,
            stream=stream,
            templates=500,
        ).expectation
    contract = calibrate(
        photos,
        [str(number // 3) for number in range(len(photos))],
        binding=Binding(
            embedder_sha256="0" * 64,
            preprocessing={},
            n=args.n,
            strategy=Strategy.ADVERSARIAL,
            m=args.dim,
            decoy_source_id=source.source_id,
            rotation_version=ROTATION_VERSION,
        ),
        source=source,
        options=CalibrationOptions(probe_dims=(0,), probe_photos=(1,)),
        expectation=expectation,
    ).contract
    rotation = TenantRotation(bytes(KEY_BYTES), args.n)
    key = bytes(range(KEY_BYTES))
    enroller = Enroller(contract, source, rotation=rotation, lift_secret=bytes(KEY_BYTES))
    stored = enroller.from_embeddings(photos[:2], holder=Holder(key, "tenant", "subject"))
    verifiers = {
        BOTH: Verifier(contract, rotation=rotation),
        TENANT: TenantOnly(contract, rotation=rotation),
        NONE: Unrotated(contract, rotation=rotation),
    }
    if not verifiers[BOTH].decide_embedding(photos[2], stored, holder_key=key).accepted:
        raise SystemExit("the person was rejected: what was timed is no decision of theirs")
    timed: dict[str, Callable[[], object]] = {
        name: partial(verifier.decide_embedding, photos[2], stored, holder_key=key)
        for name, verifier in verifiers.items()
    }
    timed |= {
        READ: partial(wire.decode, stored.wire),
        AS_STORED: partial(wire.decode_as_stored, stored.wire),
    }
    times: dict[str, list[float]] = {name: [] for name in timed}
    for turn in range(-20, args.rounds):
        for name, work in timed.items():
            started = time.process_time_ns()
            work()
            if turn >= 0:
                times[name].append((time.process_time_ns() - started) / 1e6)
    report: dict[str, object] = {"n": args.n, "m": args.dim, "rounds": args.rounds}
    for label, share in (("median", 0.5), ("quickest tenth", 0.1)):
        taken = {name: float(np.quantile(values, share)) for name, values in times.items()}
        report[label] = {
            "ms": {name: round(taken[name], 3) for name in verifiers},
            "added_ms": {name: round(taken[name] - taken[NONE], 3) for name in (TENANT, BOTH)},
            "ratio": {name: round(taken[name] / taken[NONE], 2) for name in (TENANT, BOTH)},
            "reading_ms": {name: round(taken[name], 3) for name in (READ, AS_STORED)},
        }
    print(json.dumps(report, indent=2))


if __name__ == "__main__":
    main()
