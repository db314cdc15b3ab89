"""How many strangers may make the movements of a challenge in another person's place.

Frames that turn need only reach the limit for photos of one probe, the raw cosine at FMR 1e-3, to
the mean of the frames that look ahead. So: means of k photos of one person, one photo each of
others, and how many reach the cosine at which one in 1,000 pairs of single photos of strangers do.

Example
-------
::

    python -m benchmarks.challenge_accomplice --data ../shared/data
"""

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

FMR = 1e-3
PHOTOS = (3, 5)


def cosine_of_strangers(embeddings: NDArray[np.float32], people: NDArray[np.intp]) -> float:
    """Return the cosine that one in 1,000 pairs of photos of two people reach."""
    cosines = [
        embeddings[row + 1 :][people[row + 1 :] != people[row]] @ embeddings[row]
        for row in range(len(embeddings) - 1)
    ]
    return float(np.quantile(np.concatenate(cosines), 1 - FMR))


def main() -> None:
    """Print a line for each number of photos."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    arguments = parser.parse_args()
    with np.load(arguments.data / "embeddings" / "lfw_rest.npz") as archive:
        embeddings = archive["emb_mbf"].astype(np.float32)
        names = [str(path).split("/")[-2] for path in archive["paths"]]
    embeddings /= np.linalg.norm(embeddings, axis=1, keepdims=True)
    people = np.unique(names, return_inverse=True)[1]
    limit = cosine_of_strangers(embeddings, people)
    print(f"{len(names)} photos of {people.max() + 1} people, limit {limit:.4f}")
    for count in PHOTOS:
        reached, others, victims, with_one = 0, 0, 0, 0
        for person in np.flatnonzero(np.bincount(people) >= count):
            mean = embeddings[people == person][:count].mean(axis=0)
            cosines = embeddings[people != person] @ (mean / np.linalg.norm(mean))
            passing = int((cosines >= limit).sum())
            reached, others = reached + passing, others + len(cosines)
            victims, with_one = victims + 1, with_one + bool(passing)
        print(
            f"mean of {count}: {reached} of {others} photos of others reach it "
            f"({reached / others:.5f}); of {with_one} of {victims} people somebody does"
        )


if __name__ == "__main__":
    main()
