/** Random samples from a ChaCha20 keystream, as `templates/keys/randomness.py` draws them. */

const KEY_BYTES = 32;
// "expand 32-byte k"
const CONSTANTS = [0x61707865, 0x3320646e, 0x79622d32, 0x6b206574];

/**
 * ChaCha20 keystream turned into samples; the only source of randomness of templates.
 *
 * Every template gets a stream of its own from {@link fresh}, which is destroyed when the template
 * is made: who sees one template must not be able to predict the next one's randomness.
 */
export class Keystream {
  readonly #state = new Uint32Array(16);
  readonly #block = new Uint32Array(16);
  #at = 16;
  #destroyed = false;

  /** @param key 32 bytes, used for one stream only; so the nonce may be zero. */
  constructor(key: Uint8Array) {
    if (key.length !== KEY_BYTES) throw new RangeError(`a keystream key has ${KEY_BYTES} bytes`);
    this.#state.set(CONSTANTS);
    const words = new DataView(key.buffer, key.byteOffset, KEY_BYTES);
    for (let i = 0; i < 8; i++) this.#state[4 + i] = words.getUint32(4 * i, true);
  }

  /** A stream under a new key of the platform's cryptographic generator. */
  static fresh(): Keystream {
    const key = crypto.getRandomValues(new Uint8Array(KEY_BYTES));
    const stream = new Keystream(key);
    key.fill(0);
    return stream;
  }

  /** Overwrite the key; later draws throw. */
  destroy(): void {
    this.#state.fill(0);
    this.#block.fill(0);
    this.#destroyed = true;
  }

  /** Sample U([low, high)) with 53 random bits each. */
  uniform(count: number, low = 0, high = 1): Float64Array {
    const scale = (high - low) * 2 ** -53;
    return this.#samples(count, (upper, lower) => (upper * 2 ** 21 + (lower >>> 11)) * scale + low);
  }

  /** Sample N(0, 1) by the inverse distribution function, one word of the stream each. */
  normal(count: number): Float64Array {
    return this.#samples(count, (upper, lower) =>
      inverseNormal((upper * 2 ** 20 + (lower >>> 12) + 0.5) * 2 ** -52),
    );
  }

  #samples(count: number, of: (upper: number, lower: number) => number): Float64Array {
    if (this.#destroyed) throw new Error("this keystream was destroyed: make a fresh one");
    const out = new Float64Array(count);
    for (let i = 0; i < count; i++) {
      if (this.#at === 16) this.#nextBlock();
      out[i] = of(this.#block[this.#at + 1], this.#block[this.#at]);
      this.#at += 2;
    }
    return out;
  }

  /** The next 64 bytes (RFC 8439, section 2.3). */
  #nextBlock(): void {
    const x = this.#block;
    x.set(this.#state);
    for (let round = 0; round < 10; round++) {
      for (let i = 0; i < 4; i++) quarterRound(x, i, 4 + i, 8 + i, 12 + i);
      for (let i = 0; i < 4; i++) {
        quarterRound(x, i, 4 + ((i + 1) % 4), 8 + ((i + 2) % 4), 12 + ((i + 3) % 4));
      }
    }
    for (let i = 0; i < 16; i++) x[i] += this.#state[i];
    // 2**32 blocks are 256 GiB: no template comes near.
    this.#state[12] += 1;
    this.#at = 0;
  }
}

function quarterRound(x: Uint32Array, a: number, b: number, c: number, d: number): void {
  const turned = (word: number, bits: number): number => (word << bits) | (word >>> (32 - bits));
  x[a] += x[b];
  x[d] = turned(x[d] ^ x[a], 16);
  x[c] += x[d];
  x[b] = turned(x[b] ^ x[c], 12);
  x[a] += x[b];
  x[d] = turned(x[d] ^ x[a], 8);
  x[c] += x[d];
  x[b] = turned(x[b] ^ x[c], 7);
}

// Rational approximations of Cephes (S. L. Moshier, ndtri.c), which SciPy uses; highest power first.
const TAIL = 0.13533528323661269189; // exp(-2)
const CENTRE = [
  [-59.9633501014107895267, 98.0010754185999661536, -56.6762857469070293439,
    13.9312609387279679503, -1.23916583867381258016],
  [1, 1.95448858338141759834, 4.67627912898881538453, 86.3602421390890590575,
    -225.462687854119370527, 200.260212380060660359, -82.0372256168333339912,
    15.9056225126211695515, -1.18331621121330003142],
];
const NEAR_TAIL = [
  [4.05544892305962419923, 31.5251094599893866154, 57.1628192246421288162,
    44.08050738932008347, 14.6849561928858024014, 2.18663306850790267539,
    -0.140256079171354495875, -0.0350424626827848203418, -8.57456785154685413611e-4],
  [1, 15.7799883256466749731, 45.3907635128879210584, 41.317203825467203044,
    15.0425385692907503408, 2.50464946208309415979, -0.142182922854787788574,
    -0.0380806407691578277194, -9.33259480895457427372e-4],
];
const FAR_TAIL = [
  [3.2377489177694603597, 6.91522889068984211695, 3.93881025292474443415,
    1.33303460815807542389, 0.201485389549179081538, 0.0123716634817820021358,
    3.01581553508235416007e-4, 2.65806974686737550832e-6, 6.2397453918498329373e-9],
  [1, 6.02427039364742014255, 3.67983563856160859403, 1.37702099489081330271,
    0.21623699359449663589, 0.0134204006088543189037, 3.28014464682127739104e-4,
    2.89247864745380683936e-6, 6.79019408009981274425e-9],
];

/** Standard normal quantile of a probability inside (0, 1). */
export function inverseNormal(probability: number): number {
  const ratio = ([above, below]: number[][], x: number): number => {
    const at = (coefficients: number[]): number =>
      coefficients.reduce((sum, coefficient) => sum * x + coefficient, 0);
    return at(above) / at(below);
  };
  if (probability > TAIL && probability < 1 - TAIL) {
    const y = probability - 0.5;
    const square = y * y;
    return (y + y * (square * ratio(CENTRE, square))) * Math.sqrt(2 * Math.PI);
  }
  const upper = probability > 0.5;
  const x = Math.sqrt(-2 * Math.log(upper ? 1 - probability : probability));
  const z = 1 / x;
  const size = x - Math.log(x) / x - z * ratio(x < 8 ? NEAR_TAIL : FAR_TAIL, z);
  return upper ? size : -size;
}
