// Where photos come from (camera, files, in the demo cartoon people), and a tray of those chosen.

import { camera, check, picture, unasked } from "./camera.js";
import { carriesFiles, faceBox, h, newId, takesFiles } from "./dom.js";
import { Problem, call } from "./service.js";
import { DEMO, guidance, problemBox, sentence } from "./words.js";

// What is larger is made smaller once, when it is chosen; the same bytes are then checked and sent.
// Ten of the largest stay below what a request may have.
const SIDE = 1600;
const BYTES = 2 * 1024 * 1024;

const SOURCES = { camera: "Camera", files: "Files", drawn: "Cartoon people" };

// Runs one piece of work after the other.
function inTurn() {
  let last = Promise.resolve();
  return (work) => (last = last.then(work, work));
}

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

// `replaces`: what is chosen takes the place of what was chosen before.
export function photoPicker({ most, replaces = false, onchange }) {
  const photos = [];
  const tray = h("ul", { class: "tray", "aria-label": "Chosen photos" });
  const told = h("p", { class: "hint", role: "status" });
  const panel = h("div", { class: "source" });
  const largest = h("input", { type: "checkbox", id: newId("largest") });
  const face = () => (largest.checked ? "largest" : "");
  let live = null;
  // Decoded, photos of a telephone take 50 MB each.
  const decoding = inTurn();
  const asking = inTurn();

  // A burst, some files or a cartoon: what is chosen at one time.
  function take(together) {
    // The view was left while they were on their way.
    if (ended.signal.aborted) return;
    if (replaces) [...photos].forEach(remove);
    const room = most - photos.length;
    together.slice(0, room).forEach(add);
    if (together.length > room) {
      told.textContent = replaces
        ? `No more than ${most} photos: these are the first.`
        : `No more than ${most} photos: remove one first.`;
    }
  }

  // What is no picture, such as a key file, is not sent to the service to find that out.
  function takeFiles(files) {
    const pictures = [...files].filter((file) => file.type.startsWith("image/"));
    const others = [...files].filter((file) => !pictures.includes(file));
    if (pictures.length) take(pictures.map((file) => ({ blob: file, name: file.name, seen: null })));
    if (others.length) told.textContent = `No picture: ${others.map((file) => file.name).join(", ")}.`;
  }

  // `seen` is what the service saw already in this very photo, or null.
  function add({ blob, name, seen }) {
    const photo = { blob: null, name, ...faceBox(), image: h("img", { alt: `Chosen photo, from ${name}` }) };
    photo.thumb = h("span", { class: "thumb" }, photo.image, photo.overlay);
    photo.number = h("span", { class: "number" });
    photo.said = h("span", { class: "seen", "data-state": "idle" }, "Checking…");
    photo.item = h(
      "li",
      {},
      photo.thumb,
      photo.number,
      photo.said,
      h(
        "button",
        {
          type: "button",
          class: "quiet",
          "aria-label": `Remove photo from ${name}`,
          onclick: () => {
            remove(photo);
            (tray.querySelector("button") ?? panel.querySelector("button, input, select"))?.focus();
          },
        },
        "Remove",
      ),
    );
    photos.push(photo);
    tray.append(photo.item);
    changed();
    decoding(async () => {
      if (!photos.includes(photo)) return;
      photo.blob = seen ? blob : await smaller(blob);
      if (!photos.includes(photo)) return;
      // What is sent is what is shown: its faces are found in these pixels.
      photo.image.src = URL.createObjectURL(photo.blob);
      onchange(ready());
      if (seen) tell(photo, seen);
      else look(photo);
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
    told.textContent = `${photos.length} of ${most} photos chosen.`;
    onchange(ready());
  }

  const ready = () => photos.length > 0 && photos.every((each) => each.blob);

  function look(photo) {
    asking(async () => {
      if (!photo.blob || !photos.includes(photo)) return;
      try {
        tell(photo, await check(photo.blob, face(), ended.signal));
      } catch (error) {
        if (error.name === "AbortError") return;
        if (!(error instanceof Problem)) throw error;
        if (unasked(error)) say(photo, "Not checked yet.", "idle");
        else say(photo, sentence(error.message), "bad");
      }
    });
  }

  const ended = new AbortController();

  async function tell(photo, seen) {
    say(photo, guidance(seen), seen.usable ? "good" : "bad");
    await photo.image.decode().catch(() => {});
    photo.mark(seen.box, photo.image.naturalWidth, photo.image.naturalHeight);
  }

  function say(photo, text, state) {
    photo.said.textContent = text;
    photo.said.dataset.state = state;
  }

  const builders = {
    camera() {
      live = camera({ onburst: take, face });
      return live.root;
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
      const many = `Photos: JPEG, PNG or WebP, up to ${most}`;
      const drag = h("p", { class: "hint" }, "Or drop them anywhere in this form.");
      return h("div", { class: "drop" }, h("label", { for: input.id }, many), input, drag);
    },
    drawn() {
      const who = h("select", { id: newId("who") });
      const shots = h("div", { class: "shots" });
      const show = () => {
        const urls = Array.from({ length: shown }, (_, index) => `/demo/people/${who.value}/${index}.png`);
        shots.replaceChildren(
          ...urls.map((url, index) =>
            h(
              "button",
              {
                type: "button",
                class: "shot",
                "aria-label": `Choose photo ${index + 1} of ${who.value}`,
                onclick: async () => {
                  const drawn = await fetch(url);
                  if (!drawn.ok) return;
                  const name = `${who.value}, photo ${index + 1}`;
                  take([{ blob: await drawn.blob(), name, seen: null }]);
                },
              },
              h("img", { src: url, alt: "", width: "84", height: "84" }),
            ),
          ),
        );
      };
      let shown = 0;
      who.addEventListener("change", show);
      const place = h("div", {});
      call("GET", "/demo/people")
        .then((told) => {
          shown = told.shots;
          who.append(...told.people.map((each) => h("option", {}, each)));
          show();
        })
        .catch((error) => place.replaceChildren(problemBox(error)));
      return h(
        "div",
        {},
        h("div", { class: "field" }, h("label", { for: who.id }, "Cartoon person"), who),
        shots,
        place,
      );
    },
  };

  function choose(source) {
    live?.stop();
    live = null;
    panel.replaceChildren(builders[source]());
  }

  const name = newId("source");
  const sources = Object.keys(SOURCES).filter((each) => DEMO || each !== "drawn");
  const first = DEMO ? "drawn" : "camera";
  const sourceChoice = h(
    "fieldset",
    { class: "choice" },
    h("legend", {}, `1 to ${most} photos of one person`),
    sources.map((each) => {
      const radio = h("input", {
        type: "radio",
        name,
        id: newId("source"),
        value: each,
        checked: each === first,
        onchange: () => choose(each),
      });
      return h("span", {}, radio, h("label", { for: radio.id }, SOURCES[each]));
    }),
  );
  choose(first);
  largest.addEventListener("change", () => photos.forEach(look));
  const root = h(
    "div",
    { class: "picker" },
    sourceChoice,
    DEMO
      ? h("p", { class: "hint" }, "The demo model sees only cartoon faces, not real ones.")
      : null,
    panel,
    tray,
    told,
    h(
      "p",
      { class: "check" },
      largest,
      h("label", { for: largest.id }, "Others are in the picture: use the largest face, wherever it is"),
    ),
  );
  const holds = (event) =>
    !root.hidden && !root.closest(":disabled") && carriesFiles(event) && !takesFiles(event.target);
  return {
    root,
    face,
    ready,
    // Let photos be dropped on a form.
    dropOn(form) {
      const over = (event) => form.classList.toggle("dropping", event.type === "dragover" && holds(event));
      for (const type of ["dragover", "dragleave", "drop"]) form.addEventListener(type, over);
      form.addEventListener("drop", (event) => holds(event) && takeFiles(event.dataTransfer.files));
    },
    blobs: () => photos.map((each) => each.blob),
    chosen: () => [...photos],
    // What the service said of single photos, by their places among those `sent`.
    blame(problem, sent) {
      const { image, photos: unlike } = problem.details;
      if (Number.isInteger(image) && sent[image]) {
        say(sent[image], sentence(problem.message.replace(/^photo \d+ of \d+: /, "")), "bad");
      }
      for (const index of unlike ?? []) {
        if (sent[index]) say(sent[index], "Does not look like the person in the other photos.", "bad");
      }
    },
    // Let go of the camera, which somebody else is to use.
    pause: () => choose(sourceChoice.querySelector(":checked").value),
    // Empty the tray of what was sent, of which the pictures are handed out.
    drop(sent) {
      sent.filter((each) => photos.includes(each)).forEach(remove);
      return sent.map((each) => each.thumb);
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
