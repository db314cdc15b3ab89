/** What a client needs of a contract, and the lift that it describes. */

import type { components } from "../openapi.js";
import { sha256 } from "../bytes.js";
import { unusable } from "../errors.js";
import type { PackContract } from "../models/pack.js";
import type { DecoyGenerator } from "./generator.js";
import { lift, meanEmbedding, type Strategy } from "./lifting.js";
import { encode } from "./subspace.js";

/** The answer of `GET /v1/contract`, with what a client reads of its open members. */
export type PublicContract = Omit<components["schemas"]["ContractAnswer"], "binding" | "recorded" | "calibrations"> &
  PackContract & {
    readonly binding: {
      readonly strategy: Strategy;
      readonly m: number;
      readonly axes: number;
      readonly decoy_source_id: string;
    };
    readonly calibrations: readonly { readonly mode: string; readonly probe_m: number }[];
  };

/**
 * Refuse a contract that is not what its id hashes, and a generator other than the contract's or
 * of another embedding space, whose decoys would hide nothing.
 */
export async function requireContract(contract: PublicContract, generator: DecoyGenerator): Promise<void> {
  const { binding } = contract;
  if ((await digest(binding)) !== contract.contract_id) {
    throw unusable("the contract_id is not the hash of the binding");
  }
  if (generator.sourceId !== binding.decoy_source_id || generator.k !== binding.axes) {
    throw unusable("the decoy generator is not that of the contract");
  }
  const { embedder_sha256, preprocessing } = binding;
  const space = await digest({ embedder_sha256, preprocessing });
  if (generator.madeWith !== undefined && generator.madeWith !== space) {
    throw unusable("the decoys are of another model or preprocessing, and hide nothing");
  }
}

/**
 * Average the embeddings of one person, lift them once, and encode the template's bytes.
 *
 * An enrollment has the contract's dimension; a probe `dim`, which must be calibrated, or without
 * it the largest that is.
 */
export function liftTemplate(
  contract: PublicContract,
  generator: DecoyGenerator,
  embeddings: readonly Float32Array[],
  { probe, dim }: { probe: boolean; dim?: number | undefined },
): Uint8Array {
  const { binding, contract_id, photo_consistency, probe_consistency } = contract;
  const m = probe ? probeDimension(contract, dim) : binding.m;
  const mean = meanEmbedding(embeddings, probe ? probe_consistency : photo_consistency);
  return encode(lift(mean, { strategy: binding.strategy, m, generator }), contract_id);
}

function probeDimension({ calibrations }: PublicContract, dim: number | undefined): number {
  const known = calibrations.filter(({ mode }) => mode === "s2s").map(({ probe_m }) => probe_m);
  const chosen = dim ?? Math.max(...known);
  if (known.includes(chosen)) return chosen;
  throw unusable(
    known.length === 0
      ? "the contract takes no lifted probes; calibrate it with --probe-dims"
      : `the contract takes lifted probes of dimension ${known.join(", ")}, not ${chosen}`,
  );
}

/** SHA-256 of the canonical JSON: sorted keys, no spaces. */
function digest(value: unknown): Promise<string> {
  return sha256(new TextEncoder().encode(JSON.stringify(sorted(value))));
}

function sorted(value: unknown): unknown {
  if (Array.isArray(value)) return value.map(sorted);
  if (typeof value !== "object" || value === null) return value;
  const members = Object.entries(value).sort(([a], [b]) => (a < b ? -1 : 1));
  return Object.fromEntries(members.map(([name, member]) => [name, sorted(member)]));
}
