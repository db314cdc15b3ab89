/** What lifts need of a service, shared by its clients and freed when nobody needs it any more. */

import type { ModelPack } from "../models/pack.js";
import type { PublicContract } from "../templates/contract.js";
import type { DecoyGenerator } from "../templates/generator.js";

/** What one contract lifts with; its pack is released when all that took it have left. */
export class LiftInputs {
  // Its holder's own use of it.
  #uses = 1;

  constructor(
    readonly contract: PublicContract,
    readonly generator: DecoyGenerator,
    readonly pack: ModelPack,
  ) {}

  /** Keep the pack until {@link leave}; false where it is released already. */
  take(): boolean {
    if (this.#uses === 0) return false;
    this.#uses++;
    return true;
  }

  async leave(): Promise<void> {
    this.#uses--;
    if (this.#uses === 0) await this.pack.release();
  }
}

/** The one place where the clients of a service keep what they have fetched of it. */
export class SharedInputs {
  #clients = 1;
  #inputs: Promise<LiftInputs> | undefined;

  /** Count one more client. */
  join(): this {
    this.#clients++;
    return this;
  }

  /** Count one client less; the last one frees what there is. */
  async leave(): Promise<void> {
    this.#clients--;
    if (this.#clients === 0) await this.forget();
  }

  /** Fetch once for all; the caller leaves what it got. */
  async taken(fetch: () => Promise<LiftInputs>): Promise<LiftInputs> {
    for (;;) {
      if (this.#clients === 0) throw new Error("this client was closed: make another one");
      this.#inputs ??= this.#kept(fetch());
      const inputs = await this.#inputs;
      // Between its arrival and now, another client may have forgotten it.
      if (inputs.take()) return inputs;
    }
  }

  /** Let the next lift fetch anew; of one contract only, where it is named. */
  async forget(contractId?: string): Promise<void> {
    const inputs = this.#inputs;
    // A preparation that failed holds nothing, and its error is that of who waits for it.
    const made = await inputs?.catch(() => undefined);
    if (contractId !== undefined && made?.contract.contract_id !== contractId) return;
    if (this.#inputs !== inputs) return;
    this.#inputs = undefined;
    await made?.leave();
  }

  #kept(fetching: Promise<LiftInputs>): Promise<LiftInputs> {
    const kept: Promise<LiftInputs> = fetching.catch((error: unknown) => {
      if (this.#inputs === kept) this.#inputs = undefined;
      throw error;
    });
    return kept;
  }
}
