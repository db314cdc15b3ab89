// The program of the page that benchmarks/browser_client.py visits: it logs in as any page would,
// and `window.visit` is called from outside.
import * as ort from "onnxruntime-web";
import { decodeImage, ModelPack, PrivateClient, VeilfaceError } from "veilface-client";
import { defineLogin } from "veilface-client/login";

const login = document.querySelector("veilface-login");
const face = "largest";
const probes = new Map();
const seen = [];
let prepared;
let subjectOfLogin;
let shutter;

async function authorize(subject, action) {
  const body = JSON.stringify({ subject, action });
  return (await fetch("/login/token", { method: "POST", body })).json();
}

const photo = async (name) => (await fetch(`/photos/${name}`)).blob();

async function under(subject, action, call) {
  const { token } = await authorize(subject, action);
  return call({ token });
}

// Many errors of the client have no code, and all have a name.
const nameOf = ({ code, name }) => code ?? name;

// What came of an attempt: an answer, or the error of the client in its place.
const told = (work) =>
  work.catch((error) => {
    if (!(error instanceof VeilfaceError)) throw error;
    return { error: nameOf(error) };
  });

const text = (bytes) => btoa(Array.from(bytes, (byte) => String.fromCharCode(byte)).join(""));

const since = (start) => (performance.now() - start) / 1000;

login.setAttribute("face", face);
login.options = { runtime: ort };
login.authorize = () => authorize(subjectOfLogin, "verify");
login.addEventListener("click", () => (shutter = performance.now()), { capture: true });
login.addEventListener("veilface-result", ({ detail: { accepted } }) =>
  seen.push({ seconds: since(shutter), accepted, error: null }),
);
login.addEventListener("veilface-error", ({ detail }) =>
  seen.push({ seconds: since(shutter), accepted: false, error: nameOf(detail) }),
);
defineLogin();

window.visit = {
  // Contract, generator and graphs; how long they took, and the bytes of the visit until then.
  async prepare() {
    const start = performance.now();
    const { token } = await authorize("nobody", "verify");
    prepared = new PrivateClient(location.origin, token, { runtime: ort });
    await prepared.prepare();
    const entries = performance.getEntries();
    return {
      seconds: since(start),
      bytes: entries.reduce((sum, { transferSize }) => sum + (transferSize ?? 0), 0),
    };
  },

  enroll: async (subject, names) => {
    const photos = await Promise.all(names.map(photo));
    return told(under(subject, "enroll", (given) => prepared.enroll(subject, photos, { ...given, face })));
  },

  // One photo, from the moment it is there to the answer.
  verify: async (subject, name) => {
    const data = await photo(name);
    const start = performance.now();
    const answer = await told(
      prepared.lift([data], { face }).then((probe) => {
        probes.set(name, probe);
        return under(subject, "verify", (given) => prepared.verify(subject, probe, given));
      }),
    );
    return { ...answer, seconds: since(start) };
  },

  // The probe of a photo, lifted once for all its attempts: for nobody else, if not for its person.
  attempt: async (subject, name) =>
    probes.has(name)
      ? told(under(subject, "verify", (given) => prepared.verify(subject, probes.get(name), given)))
      : { error: "not_lifted" },

  // The next logins of the element are this person's.
  meet(subject) {
    subjectOfLogin = subject;
  },
  seen: () => seen,
  leave() {
    const place = login.parentNode;
    login.remove();
    place.append(login);
  },

  // What the camera of the element shows, as PNG in base64: for the search, not for the network.
  async frame() {
    const video = login.shadowRoot.querySelector("video");
    const canvas = new OffscreenCanvas(video.videoWidth, video.videoHeight);
    canvas.getContext("2d").drawImage(video, 0, 0);
    return text(new Uint8Array(await (await canvas.convertToBlob()).arrayBuffer()));
  },

  // Send what no client sends, so that it is found.
  async plant(form, name) {
    const data = await photo(name);
    const { token } = await authorize("nobody", "verify");
    const client = new PrivateClient(location.origin, token, { runtime: ort });
    const pack = await ModelPack.load(ort, await client.contract(), await client.pack());
    const image = await decodeImage(data);
    const { crop, embedding } = await pack.embedPhoto(image, face);
    await pack.release();
    const floats = new Uint8Array(embedding.buffer, embedding.byteOffset, embedding.byteLength);
    const forms = {
      photo: data,
      "half of a photo": data.slice(data.size / 2),
      "base64 of a photo": text(new Uint8Array(await data.arrayBuffer())),
      "decoded pixels": image.data,
      "aligned crop": crop.data,
      float32: floats,
      float64: Float64Array.from(embedding),
      "base64 of float32": text(floats),
      "decimal text": JSON.stringify(Array.from(embedding)),
    };
    await fetch("/v1/planted", { method: "POST", body: forms[form] });
  },
};
