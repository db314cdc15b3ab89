/** Random samples from the platform's cryptographic generator: the only randomness of templates. */

// More than this is refused in one call (Web Cryptography API, section 10.1.1).
const MOST_WORDS = 65536 / 4;

/** Sample U([low, high)) with 53 random bits each. */
export function uniform(count: number, low = 0, high = 1): Float64Array {
  const words = new Uint32Array(2 * count);
  for (let start = 0; start < words.length; start += MOST_WORDS) {
    crypto.getRandomValues(words.subarray(start, start + MOST_WORDS));
  }
  const scale = (high - low) * 2 ** -53;
  return Float64Array.from(
    { length: count },
    (_, i) => (words[2 * i] * 2 ** 21 + (words[2 * i + 1] >>> 11)) * scale + low,
  );
}

/** Sample N(0, 1) by the method of Box and Muller. */
export function normal(count: number): Float64Array {
  const pairs = Math.ceil(count / 2);
  const samples = uniform(2 * pairs);
  for (let i = 0; i < 2 * pairs; i += 2) {
    // In (0, 1], so that the logarithm is finite.
    const radius = Math.sqrt(-2 * Math.log(1 - samples[i]));
    const angle = 2 * Math.PI * samples[i + 1];
    samples[i] = radius * Math.cos(angle);
    samples[i + 1] = radius * Math.sin(angle);
  }
  return samples.subarray(0, count);
}
