/** Draw and lift for tests/clients/javascript/test_lifting.py. */

import {
  DecoyGenerator,
  encode,
  InconsistentImages,
  inverseNormal,
  Keystream,
  lift,
  liftTemplate,
  meanEmbedding,
  requireContract,
  TemplateError,
} from "../../dist/index.js";
import { bytes, input, output, text } from "./io.js";

const floats = (encoded) => new Float32Array(bytes(encoded).buffer);

const calls = {
  quantiles: ({ probabilities }) => probabilities.map(inverseNormal),

  draws({ key, count }) {
    const stream = new Keystream(bytes(key));
    return [stream.uniform(count), stream.normal(count), stream.uniform(count, -1, 1)].map(text);
  },

  async read({ generator }) {
    return (await DecoyGenerator.fromBytes(bytes(generator))).noise;
  },

  async lift({ key, descriptor, generator, strategy, m, contract_id }) {
    const source = await DecoyGenerator.fromBytes(bytes(generator));
    const stream = new Keystream(bytes(key));
    const begun = performance.now();
    const subspace = lift(floats(descriptor), { strategy, m, generator: source, stream });
    const milliseconds = performance.now() - begun;
    return {
      foot: text(subspace.foot),
      basis: text(subspace.basis),
      wire: text(encode(subspace, contract_id)),
      source_id: source.sourceId,
      milliseconds,
    };
  },

  /** Under keys of this process's own. */
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
    if (!(error instanceof TemplateError)) throw error;
    const { name, message } = error;
    if (!(error instanceof InconsistentImages)) return { error: name, message };
    return { error: name, message, apart: error.apart, others: error.others };
  }
}

const answers = [];
for (const question of await input()) answers.push(await answer(question));
output(answers);
