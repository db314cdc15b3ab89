// Sign-in, navigation and focus; each view is a module of its own.

import { carriesFiles, field, h, takesFiles } from "./dom.js";
import { enrollView } from "./enroll.js";
import { peopleView } from "./people.js";
import { serviceView } from "./status.js";
import { forgetKey, hasKey, learn, session, useKey } from "./service.js";
import { verifyView } from "./verify.js";
import { problemBox } from "./words.js";

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
  open?.stop();
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
  nav.replaceChildren(
    h(
      "ul",
      {},
      Object.entries(VIEWS).map(([name, [title]]) =>
        h("li", {}, h("a", { href: `#/${name}`, "data-view": name }, title)),
      ),
    ),
  );
  who.replaceChildren(
    h("span", { class: "fine" }, h("code", {}, `vf_${session.own.prefix}_…`)),
    h("button", { type: "button", class: "quiet", onclick: () => signOut(null) }, "Sign out"),
  );
  nav.hidden = who.hidden = false;
  if (session.own.demo) document.documentElement.dataset.demo = "yes";
  route(focus);
}

function signOut(problem) {
  forgetKey();
  nav.hidden = who.hidden = true;
  show(signInView(problem), "Sign in");
}

function signInView(problem = null) {
  const key = h("input", {
    type: "password",
    id: "key",
    required: true,
    autocomplete: "off",
    spellcheck: "false",
  });
  const keep = h("input", { type: "checkbox", id: "keep", checked: true, "aria-describedby": "keep-hint" });
  const send = h("button", { type: "submit" }, "Sign in");
  const trouble = h("div", {}, problem ? problemBox(problem) : null);

  async function submit(event) {
    event.preventDefault();
    const token = key.value.trim();
    // A header carries visible ASCII only; anything else is no key.
    if (!/^[!-~]+$/.test(token)) {
      trouble.replaceChildren(
        problemBox({ code: "unauthorized", message: "that is not an API key: keys begin with vf_", details: {} }),
      );
      return;
    }
    send.disabled = true;
    trouble.replaceChildren();
    useKey(token, keep.checked);
    try {
      await learn();
      signedIn(true);
    } catch (error) {
      forgetKey();
      trouble.replaceChildren(problemBox(error));
      send.disabled = false;
      key.focus();
    }
  }

  const root = h(
    "section",
    { class: "sign-in" },
    h("h1", { tabindex: "-1" }, "Sign in"),
    h("p", { class: "lead" }, "Enroll people, verify them, and erase them."),
    h(
      "form",
      { class: "card", onsubmit: submit },
      field("API key", key, [
        "The service prints one when it first starts; ",
        h("code", {}, "veilface keys create"),
        " creates more.",
      ]),
      h("p", { class: "check" }, keep, h("label", { for: "keep" }, "Keep me signed in until I close this tab")),
      h(
        "p",
        { class: "hint", id: "keep-hint" },
        "A reload keeps it; a browser that restores the tab may bring it back. Sign out ends it.",
      ),
      send,
    ),
    trouble,
  );
  return { root, stop() {} };
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
// Files that miss a form that takes photos must not replace the page.
for (const type of ["dragover", "drop"]) {
  addEventListener(type, (event) => {
    if (carriesFiles(event) && !takesFiles(event.target)) event.preventDefault();
  });
}

if (hasKey()) {
  try {
    await learn();
    signedIn(false);
  } catch (error) {
    if (error.status === 401) signOut(error);
    else show(signInView(error), "Sign in", false);
  }
} else {
  show(signInView(), "Sign in", false);
}
