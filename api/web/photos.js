// Where photos come from (camera, files, in the demo cartoon people), and a tray of those chosen.

import { BURST, camera, check, picture, unasked } from "./camera.js";
import { carriesFiles, choice, faceBox, h, newId } from "./dom.js";
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
    return (await picture(bitmap, bitmap.width, bitmap.height, { side: SIDE })).blob;
  } catch {
    return blob;
  } finally {
    bitmap?.close();
  }
}

// `most` photos; with `replaces`, what is chosen takes the place of what was chosen before. With `shutter` the camera has
// a button of its own; else `live()` is the camera, where that is the source. `onchange` is called where the chosen photos
// change, `onsource` where the camera goes on or off or other photos are offered.
export function photoPicker({ most, replaces = false, shutter = false, onchange, onsource }) {
  const photos = [];
  const tray = h("ul", { class: "tray", "aria-label": "Chosen photos" });
  const status = h("p", { class: "hint", role: "status" });
  const panel = h("div", { class: "source" });
  const largest = h("input", { type: "checkbox", id: newId("largest"), onchange: () => photos.forEach(look) });
  const face = () => (largest.checked ? "largest" : "");
  const ended = new AbortController();
  let live = null;
  // One after the other: decoded, photos of a telephone take 50 MB each.
  let last = Promise.resolve();
  const inTurn = (work) => (last = last.then(work, work));

  // A burst, some files or a cartoon: what is chosen at one time.
  function take(together) {
    // The view was left while they were on their way.
    if (ended.signal.aborted) return;
    if (replaces) [...photos].forEach(remove);
    const room = most - photos.length;
    together.slice(0, room).forEach(add);
    if (together.length > room) {
      status.textContent = `No more than ${most} photos: ${replaces ? "these are the first" : "remove one first"}.`;
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
    const photo = { blob: ready, name, ...faceBox(), image: h("img", { alt: `Chosen photo, from ${name}` }) };
    photo.thumb = h("span", { class: "thumb" }, photo.image, photo.overlay);
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
        await photo.image.decode().catch(() => {});
        photo.mark(seen.box, photo.image.naturalWidth, photo.image.naturalHeight);
      } catch (error) {
        if (error.name === "AbortError") return;
        if (!(error instanceof Problem)) throw error;
        if (unasked(error)) say(photo, "Not checked yet.", "idle");
        else say(photo, sentence(error.message), "bad");
      }
    });
  }

  function say(photo, text, state) {
    photo.verdict.textContent = text;
    photo.verdict.dataset.state = state;
  }

  const sources = {
    camera() {
      const verb = () => (live?.isOn() ? `Take ${BURST} photos` : "Start camera");
      const button = h("button", { type: "button", class: "secondary", onclick: press }, verb());
      live = camera({
        face,
        onchange: () => {
          button.textContent = verb();
          onsource();
        },
      });
      async function press() {
        button.disabled = true;
        if (live.isOn()) take(await live.burst());
        else await live.begin();
        button.disabled = false;
        // A button that is switched off loses the focus.
        if (document.activeElement === document.body) button.focus();
      }
      return [live.root, shutter ? h("p", { class: "row" }, button) : ""];
    },
    files() {
      const input = h("input", {
        type: "file",
        class: "unseen",
        id: newId("files"),
        accept: "image/jpeg,image/png,image/webp",
        multiple: true,
        onchange: () => {
          takeFiles(input.files);
          input.value = "";
        },
      });
      const hint = h("span", { class: "hint" }, `JPEG, PNG or WebP, up to ${most}`);
      return [input, h("label", { class: "drop", for: input.id }, h("strong", {}, "Choose photos, or drop them here"), hint)];
    },
    drawn() {
      const who = h("select", { id: newId("who"), onchange: show });
      const shots = h("div", { class: "shots" });
      let count = 0;
      function show() {
        shots.replaceChildren(
          ...Array.from({ length: count }, (_, index) => {
            const url = `${BASE}/demo/people/${who.value}/${index}.png`;
            const name = `${who.value}, photo ${index + 1}`;
            const choose = async () => {
              const drawn = await fetch(url);
              if (drawn.ok) take([{ blob: await drawn.blob(), name }]);
            };
            const label = `Choose photo ${index + 1} of ${who.value}`;
            return h(
              "button",
              { type: "button", class: "shot", "aria-label": label, onclick: choose },
              h("img", { src: url, alt: "", width: "84", height: "84" }),
            );
          }),
        );
      }
      const place = h("div", {});
      call("GET", "/demo/people")
        .then(({ people, shots: each }) => {
          count = each;
          who.append(...people.map((person) => h("option", {}, person)));
          show();
        })
        .catch((error) => place.replaceChildren(problemBox(error)));
      return [h("div", { class: "field" }, h("label", { for: who.id }, "Cartoon person"), who), shots, place];
    },
  };

  function choose(source) {
    live?.stop();
    live = null;
    panel.replaceChildren(...sources[source]());
    onsource();
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
  const holds = (event) => !root.hidden && !root.closest(":disabled") && carriesFiles(event);
  return {
    root,
    option,
    face,
    take,
    live: () => live,
    start: () => choose(source.value()),
    ready: () => photos.length > 0 && photos.every((photo) => photo.blob),
    // Let photos be dropped on a form.
    dropOn: (form) => form.addEventListener("drop", (event) => holds(event) && takeFiles(event.dataTransfer.files)),
    blobs: () => photos.map((photo) => photo.blob),
    chosen: () => [...photos],
    // What the service said of single photos, by their places among those `sent`.
    blame(problem, sent) {
      const { image, photos: unlike } = problem.details;
      if (sent[image]) say(sent[image], sentence(problem.message.replace(/^photo \d+ of \d+: /, "")), "bad");
      for (const index of unlike ?? []) {
        if (sent[index]) say(sent[index], "Does not look like the person in the other photos.", "bad");
      }
    },
    // Empty the tray of what was sent, of which the pictures are handed out.
    drop(sent) {
      sent.filter((photo) => photos.includes(photo)).forEach(remove);
      return sent.map((photo) => photo.thumb);
    },
    stop: () => {
      live?.stop();
      ended.abort();
      photos.forEach(forget);
      // One that is still decoded gets no address.
      photos.length = 0;
    },
  };
}
