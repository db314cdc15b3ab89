// The password goes to our own server, and to Veilface a private template alone: the element embeds
// and lifts here. Neither gets a photo.
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
login.authorize = () => own("/token");

// What counts is what the server learned itself, after an error too: an answer may have been lost.
async function ended() {
  const { accepted, name } = await own("/face").catch(({ message }) => ((output.value = message), {}));
  if (!accepted) return;
  login.remove();
  output.value = `Welcome, ${name}`;
}
login.addEventListener("veilface-result", ended);
login.addEventListener("veilface-error", ended);

form.addEventListener("submit", async (event) => {
  event.preventDefault();
  const { name, password } = Object.fromEntries(new FormData(form));
  login.remove();
  output.value = "…";
  try {
    await own(event.submitter.value, { name, password });
    const { service, action } = await own("/token");
    login.setAttribute("service", service);
    login.setAttribute("action", action);
    form.after(login);
    output.value = action === "enroll" ? "Now enroll your face" : "Now show your face";
  } catch (error) {
    output.value = error.message;
  }
});
