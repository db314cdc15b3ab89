// Sign-in, navigation and focus; each view is a module of its own.

import { command, field, h } from "./dom.js";
import { enrollView } from "./enroll.js";
import { peopleView } from "./people.js";
import { serviceView } from "./status.js";
import { forgetKey, hasKey, learn, session, useKey } from "./service.js";
import { verifyView } from "./verify.js";
import { DEMO, problemBox } from "./words.js";

const VIEWS = {
  verify: ["Verify", verifyView],
  enroll: ["Enroll", enrollView],
  people: ["People", peopleView],
  service: ["Service", serviceView],
};
const main = document.getElementById("main");
const nav = document.getElementById("nav");
const who = document.getElementById("who");
let open = null;

function show(view, title, focus = true) {
  open?.stop?.();
  open = view;
  main.replaceChildren(view.root);
  document.title = `${title} · Veilface`;
  if (focus) {
    view.root.querySelector("h1").focus({ preventScroll: true });
    scrollTo(0, 0);
  }
}

function route(focus = true) {
  if (!session.own) return;
  const [, name, id] = location.hash.split("/");
  const known = Object.hasOwn(VIEWS, name ?? "") ? name : "verify";
  for (const link of nav.querySelectorAll("a")) {
    if (link.dataset.view === known) link.setAttribute("aria-current", "page");
    else link.removeAttribute("aria-current");
  }
  const [title, view] = VIEWS[known];
  let subject = "";
  try {
    subject = decodeURIComponent(id ?? "");
  } catch {
    // A truncated link names nobody.
  }
  show(view(subject), title, focus);
}

function signedIn(focus) {
  const links = Object.entries(VIEWS).map(([name, [title]]) =>
    h("li", {}, h("a", { href: `#/${name}`, "data-view": name }, title)),
  );
  nav.replaceChildren(h("ul", {}, links));
  who.replaceChildren(
    h("code", { class: "fine" }, `vf_${session.own.prefix}_…`),
    h("button", { type: "button", class: "quiet", onclick: () => signOut(null) }, "Sign out"),
  );
  nav.hidden = who.hidden = false;
  if (session.own.demo) document.documentElement.dataset.demo = "yes";
  route(focus);
}

function signOut(problem) {
  forgetKey();
  // It may name a person.
  history.replaceState(null, "", location.pathname + location.search);
  nav.hidden = who.hidden = true;
  show(signInView(problem), "Sign in");
}

// Go on with the key that this tab has kept.
async function resume() {
  try {
    await learn();
    signedIn(false);
  } catch (error) {
    // The key is kept where the service does not say whether it is good: a reload tries again.
    if (error.status === 401) signOut(error);
    else show(signInView(error), "Sign in", false);
  }
}

function signInView(problem = null) {
  const key = h("input", { type: "password", id: "key", required: true, autocomplete: "off", spellcheck: "false" });
  const keep = h("input", { type: "checkbox", id: "keep", checked: true, "aria-describedby": "keep-hint" });
  const send = h("button", { type: "submit" }, "Sign in");
  const trouble = h("div", {}, problem ? problemBox(problem) : null);

  async function submit(event) {
    event.preventDefault();
    const token = key.value.trim();
    send.disabled = true;
    trouble.replaceChildren();
    try {
      useKey(token, keep.checked);
      await learn();
      signedIn(true);
    } catch (error) {
      forgetKey();
      trouble.replaceChildren(problemBox(error));
      send.disabled = false;
      key.focus();
    }
  }

  const file = DEMO ? "demo-data/api-key" : "veilface-data-keys/api-key";
  const root = h(
    "section",
    { class: "sign-in" },
    h(
      "div",
      {},
      h("p", { class: "claim-line" }, "Face login that never stores a face."),
      h("p", {}, "Only a set with decoys is kept, encrypted: the face is one point of it among many. Photos and embeddings are forgotten."),
    ),
    h(
      "div",
      {},
      h(
        "form",
        { class: "card", onsubmit: submit },
        h("h1", { tabindex: "-1" }, "Sign in"),
        field("API key", key),
        h("p", { class: "check" }, keep, h("label", { for: "keep" }, "Keep me signed in until I close this tab")),
        send,
        h("p", { class: "hint", id: "keep-hint" }, "A browser that restores the tab may bring the key back. Sign out ends it."),
        trouble,
      ),
      h(
        "section",
        { class: "aside" },
        h("h2", {}, "Where is my key?"),
        h("p", {}, command(`veilface ${DEMO ? "demo" : "setup"}`), " wrote it to a file, which this prints:"),
        h("pre", {}, command(`cat ${file}`)),
        DEMO ? null : h("p", {}, "This makes another, with the rights that you name:"),
        DEMO ? null : h("pre", {}, command("veilface keys create --right verify")),
      ),
    ),
  );
  return { root };
}

session.onrefused = (problem) => {
  problem.title = "You were signed out: the service no longer accepts this API key.";
  signOut(problem);
};
document.querySelector(".skip").addEventListener("click", (event) => {
  // Without a change of the address, which names the view.
  event.preventDefault();
  main.focus();
});
addEventListener("hashchange", () => route());
// Files that miss the field for photos must not replace the page.
for (const type of ["dragover", "drop"]) {
  addEventListener(type, (event) => {
    if (event.target.type !== "file" && event.dataTransfer.types.includes("Files")) event.preventDefault();
  });
}

if (hasKey()) await resume();
else show(signInView(), "Sign in", false);
