// Where photos come from (camera, files, in the demo cartoon people), and a tray of those chosen.

import { BURST, camera, check, picture } from "./camera.js";
import { choice, field, h, newId } from "./dom.js";
import { BASE, Problem, call } from "./service.js";
import { DEMO, guidance, problemBox, sentence } from "./words.js";

// What is larger is made smaller once, when it is chosen; the same bytes are then checked and sent.
// Ten of the largest stay below what a request may have.
const SIDE = 1600;
const BYTES = 2 * 1024 * 1024;

// What the browser cannot decode or draw goes to the service as it is, which says why it will not do.
async function smaller(blob) {
  let bitmap = null;
  try {
    bitmap = await createImageBitmap(blob);
    if (Math.max(bitmap.width, bitmap.height) <= SIDE && blob.size <= BYTES) return blob;
    return await picture(bitmap, bitmap.width, bitmap.height, { side: SIDE });
  } catch {
    return blob;
  } finally {
    bitmap?.close();
  }
}

// `most` photos. With `sends`, what is chosen takes the place of what was chosen before, and the camera's photos are sent at
// once by its button, which says `sends`. `onchange` is called where the chosen photos or their source change.
export function photoPicker({ most, sends = null, onchange }) {
  const photos = [];
  const tray = h("ul", { class: "tray", "aria-label": "Chosen photos" });
  const status = h("p", { class: "hint", role: "status" });
  const panel = h("div", { class: "source" });
  const largest = h("input", { type: "checkbox", id: newId("largest"), onchange: () => (photos.forEach(look), onchange()) });
  const face = () => (largest.checked ? "largest" : "");
  const ended = new AbortController();
  let live = null;
  // One after the other: decoded, photos of a telephone take 50 MB each.
  let last = Promise.resolve();
  const inTurn = (work) => (last = last.then(work, work));

  // A burst, some files or a cartoon: what is chosen at one time.
  function take(together) {
    // The view was left, or private mode switched on, while they were on their way.
    if (ended.signal.aborted || root.hidden) return;
    if (sends) [...photos].forEach(remove);
    const room = most - photos.length;
    together.slice(0, room).forEach(add);
    if (together.length > room) {
      status.textContent = `No more than ${most} photos: ${sends ? "these are the first" : "remove one first"}.`;
    }
  }

  // What is no picture, such as a document, is not sent to the service to find that out.
  function takeFiles(files) {
    const pictures = [...files].filter((file) => file.type.startsWith("image/"));
    const others = [...files].filter((file) => !pictures.includes(file));
    if (pictures.length) take(pictures.map((file) => ({ blob: file, name: file.name })));
    if (others.length) status.textContent = `No picture: ${others.map((file) => file.name).join(", ")}.`;
  }

  function add({ blob, name }) {
    // What the camera took has its size already.
    const ready = name === "camera" ? blob : null;
    const photo = { blob: ready, name, image: h("img", { alt: `Chosen photo, from ${name}` }) };
    photo.thumb = h("span", { class: "thumb" }, photo.image);
    photo.number = h("span", { class: "number" });
    photo.verdict = h("span", { class: "seen", "data-state": "idle" }, "Checking…");
    const drop = () => {
      remove(photo);
      (tray.querySelector("button") ?? panel.querySelector("button, input, select"))?.focus();
    };
    const label = `Remove photo from ${name}`;
    photo.item = h(
      "li",
      {},
      photo.thumb,
      photo.number,
      photo.verdict,
      h("button", { type: "button", class: "remove", "aria-label": label, title: "Remove", onclick: drop }, "✕"),
    );
    photos.push(photo);
    tray.append(photo.item);
    changed();
    inTurn(async () => {
      if (!photos.includes(photo)) return;
      photo.blob ??= await smaller(blob);
      if (!photos.includes(photo)) return;
      // What is sent is what is shown: its faces are found in these pixels.
      photo.image.src = URL.createObjectURL(photo.blob);
      if (!ready) onchange();
      look(photo);
    });
  }

  function remove(photo) {
    forget(photo);
    photo.item.remove();
    photos.splice(photos.indexOf(photo), 1);
    changed();
  }

  const forget = (photo) => URL.revokeObjectURL(photo.image.src);

  function changed() {
    // The numbers that the service's messages use.
    photos.forEach((photo, index) => (photo.number.textContent = `Photo ${index + 1}`));
    status.textContent = photos.length ? `${photos.length} of ${most} photos chosen.` : "";
    onchange();
  }

  function look(photo) {
    inTurn(async () => {
      if (!photo.blob || !photos.includes(photo)) return;
      try {
        const seen = await check(photo.blob, face(), ended.signal);
        say(photo, seen.usable ? "Good" : guidance(seen), seen.usable ? "good" : "bad");
      } catch (error) {
        if (error.name === "AbortError") return;
        if (!(error instanceof Problem)) throw error;
        say(photo, sentence(error.message), error.status === 400 ? "bad" : "idle");
      }
    });
  }

  function say(photo, text, state) {
    photo.verdict.textContent = text;
    photo.verdict.dataset.state = state;
  }

  const sources = {
    camera() {
      const verb = () => (live?.isOn() ? sends ?? `Take ${BURST} photos` : "Start camera");
      const button = h("button", { type: "button", class: sends ? "primary" : "secondary", onclick: press }, verb());
      live = camera({ face, onchange: () => (button.textContent = verb()) });
      async function press() {
        if (!live.isOn()) return live.begin();
        if (sends && !button.form.reportValidity()) return;
        const burst = await live.burst();
        take(burst);
        if (sends && burst.length) button.form.requestSubmit();
      }
      return [live.root, h("p", { class: "row" }, button)];
    },
    files() {
      const input = h("input", {
        type: "file",
        id: newId("files"),
        accept: "image/jpeg,image/png,image/webp",
        multiple: true,
        onchange: () => {
          takeFiles(input.files);
          input.value = "";
        },
      });
      const hint = h("span", { class: "hint" }, `JPEG, PNG or WebP, up to ${most}`);
      const label = h("label", { for: input.id }, h("strong", {}, "Choose photos, or drop them here"));
      // The field covers its words: the browser itself takes what is dropped on it.
      return [h("div", { class: "drop" }, label, hint, input)];
    },
    drawn() {
      const who = h("select", { id: newId("who"), onchange: show });
      const shots = h("div", { class: "shots" });
      let count = 0;
      function show() {
        shots.replaceChildren(...Array.from({ length: count }, (_, index) => shot(who.value, index)));
      }
      call("GET", "/demo/people")
        .then(({ people, shots: each }) => {
          count = each;
          who.append(...people.map((person) => h("option", {}, person)));
          show();
        })
        .catch((error) => shots.replaceChildren(problemBox(error)));
      return [field("Cartoon person", who), shots];
    },
  };

  function shot(person, index) {
    const url = `${BASE}/demo/people/${person}/${index}.png`;
    const choose = async () => {
      const drawn = await fetch(url);
      if (drawn.ok) take([{ blob: await drawn.blob(), name: `${person}, photo ${index + 1}` }]);
    };
    return h(
      "button",
      { type: "button", class: "shot", "aria-label": `Choose photo ${index + 1} of ${person}`, onclick: choose },
      h("img", { src: url, alt: "", width: "84", height: "84" }),
    );
  }

  function choose(source) {
    live?.stop();
    live = null;
    panel.replaceChildren(...sources[source]());
    onchange();
  }

  const names = { ...(DEMO ? { drawn: "Cartoon people" } : {}), camera: "Camera", files: "Files" };
  const source = choice("Photos from", names, { value: Object.keys(names)[0], onchange: choose });
  const root = h(
    "div",
    { class: "picker" },
    source.root,
    DEMO ? h("p", { class: "hint" }, "The demo model sees only cartoon faces, not real ones.") : null,
    panel,
    tray,
    status,
  );
  const option = h(
    "p",
    { class: "check" },
    largest,
    h("label", { for: largest.id }, "Others are in the picture: use the largest face, wherever it is"),
  );
  return {
    root,
    option,
    face,
    hasShutter: () => live !== null && sends !== null,
    start: () => choose(source.value()),
    ready: () => photos.length > 0 && photos.every((photo) => photo.blob),
    blobs: () => photos.map((photo) => photo.blob),
    chosen: () => [...photos],
    // Empty the tray of what was sent.
    drop: (sent) => sent.filter((photo) => photos.includes(photo)).forEach(remove),
    stop: () => {
      live?.stop();
      ended.abort();
      photos.forEach(forget);
      // One that is still decoded gets no address.
      photos.length = 0;
    },
  };
}
