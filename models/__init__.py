"""From bytes to embedding: decoding, packs, detection, alignment, embedding."""
