// The password goes to our own server, and to Veilface only a private template of the face: the
// element embeds and lifts here. Neither gets a photo.
import { defineLogin } from "/client/element/login.js";
import * as ort from "/ort/ort.wasm.min.mjs";

const form = document.querySelector("form");
const output = document.querySelector("output");

async function own(path, body) {
  const headers = body && { "Content-Type": "application/json" };
  const answer = await fetch(path, { method: "POST", body: body && JSON.stringify(body), headers });
  const text = await answer.text();
  const told = text ? JSON.parse(text) : {};
  if (!answer.ok) throw new Error(typeof told.detail === "string" ? told.detail : "check what you typed");
  return told;
}

defineLogin();
const login = document.createElement("veilface-login");
login.options = { runtime: ort };
// The server says who is let in.
login.words = { accept: "", enrolled: "" };
let attempts = 0; // and preparations of one: each takes a token
login.authorize = () => {
  attempts++;
  return own("/token");
};

const after = (milliseconds) => new Promise((resolve) => setTimeout(resolve, milliseconds));

function ask({ service, action }) {
  login.setAttribute("service", service);
  login.setAttribute("action", action);
  output.value = action === "enroll" ? "Now enroll your face" : "Now show your face";
}

// What counts is what the server learned itself, after an error too: an answer may have been lost.
async function ended() {
  const attempt = attempts;
  // The server keeps what it could not ask the service yet, until another token is taken.
  for (let wait = 0; wait < 60000; wait = 2 * wait || 2000) {
    await after(wait);
    if (attempts !== attempt) return;
    const told = await own("/face").catch((error) => ({ error }));
    if (attempts !== attempt) return;
    if (told.error) {
      output.value = told.error.message;
      continue;
    }
    if (!told.accepted) return ask(told);
    login.remove();
    output.value = `Welcome, ${told.name}`;
    return;
  }
}
login.addEventListener("veilface-result", ended);
login.addEventListener("veilface-error", ended);

form.addEventListener("submit", async (event) => {
  event.preventDefault();
  const { name, password } = Object.fromEntries(new FormData(form));
  login.remove();
  attempts++;
  output.value = "…";
  try {
    ask(await own(event.submitter.value, { name, password }));
    form.after(login);
  } catch (error) {
    output.value = error.message;
  }
});
