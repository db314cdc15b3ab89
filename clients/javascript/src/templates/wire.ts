/** The bytes of a private template on the wire (docs/formats.md), float16. */

import type { AffineSubspace } from "./subspace.js";

/** The bytes of a template: safetensors with one canonical header, float16. */
export function encode({ foot, basis }: AffineSubspace, contractId: string): Uint8Array {
  const [k, m] = [foot.length, basis.length / foot.length];
  const [split, end] = [2 * k, 2 * k * (m + 1)];
  const header = JSON.stringify({
    __metadata__: { format: "veilface-template", version: "1", contract_id: contractId },
    foot: { dtype: "F16", shape: [k], data_offsets: [0, split] },
    basis: { dtype: "F16", shape: [m, k], data_offsets: [split, end] },
  });
  const text = new TextEncoder().encode(header.padEnd(8 * Math.ceil(header.length / 8), " "));
  const bytes = new Uint8Array(8 + text.length + end);
  const view = new DataView(bytes.buffer);
  view.setBigUint64(0, BigInt(text.length), true);
  bytes.set(text, 8);
  let at = 8 + text.length;
  for (const values of [foot, basis]) {
    for (const value of values) {
      view.setUint16(at, float16(value), true);
      at += 2;
    }
  }
  return bytes;
}

/** Bits of the nearest float16 to a number of at most 1 in size, halves to the even one. */
export function float16(value: number): number {
  const sign = value < 0 || Object.is(value, -0) ? 0x8000 : 0;
  const size = Math.abs(value);
  // Below 2**-14 steps are 2**-24; above they grow with the exponent.
  const exponent = size < 2 ** -14 ? -14 : Math.floor(Math.log2(size));
  const scaled = size / 2 ** (exponent - 10);
  const low = Math.floor(scaled);
  const share = scaled - low;
  const steps = share > 0.5 || (share === 0.5 && low % 2 === 1) ? low + 1 : low;
  // A carry out of the steps raises the exponent, as the bits are laid out for it.
  return sign | (((exponent + 14) << 10) + steps);
}
