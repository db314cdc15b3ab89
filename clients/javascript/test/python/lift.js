/** Draw and lift for tests/clients/javascript/test_lifting.py. */

import { DecoyGenerator, lift, liftTemplate, meanEmbedding, requireContract, VeilfaceError } from "../../dist/index.js";
import { normal, uniform } from "../../dist/templates/samples.js";
import { encode } from "../../dist/templates/subspace.js";
import { bytes, input, output, text } from "./io.js";

const floats = (encoded) => new Float32Array(bytes(encoded).buffer);

const calls = {
  draws: ({ count }) => [
    text(uniform(count, -1, 1)),
    text(normal(count)),
  ],

  async read({ generator }) {
    const { n, k, sourceId } = await DecoyGenerator.fromBytes(bytes(generator));
    return { n, k, source_id: sourceId };
  },

  async project({ generator, embedding }) {
    return text((await DecoyGenerator.fromBytes(bytes(generator))).project(floats(embedding)));
  },

  async decoys({ generator, count }) {
    const source = await DecoyGenerator.fromBytes(bytes(generator));
    return text(Float32Array.from(source.draw(count).flatMap((row) => [...row])));
  },

  async lift({ embedding, generator, strategy, m, contract_id }) {
    const source = await DecoyGenerator.fromBytes(bytes(generator));
    const { foot, basis } = lift(floats(embedding), { strategy, m, generator: source });
    const wire = text(encode({ foot, basis }, contract_id));
    return { foot: text(foot), basis: text(basis), wire };
  },

  async template({ contract, generator, embeddings, probe, dim }) {
    const source = await DecoyGenerator.fromBytes(bytes(generator));
    await requireContract(contract, source);
    const options = { probe, dim: dim ?? undefined };
    return text(liftTemplate(contract, source, embeddings.map(floats), options));
  },

  mean({ embeddings, consistency }) {
    return text(meanEmbedding(embeddings.map(floats), consistency));
  },
};

async function answer({ call, ...given }) {
  try {
    return { value: await calls[call](given) };
  } catch (error) {
    if (!(error instanceof VeilfaceError)) throw error;
    const { code, message, details } = error;
    return { code, message, details };
  }
}

const answers = [];
for (const question of await input()) answers.push(await answer(question));
output(answers);
