// The password goes to our own server, the photo to Veilface alone, with a token for one attempt.
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

async function show(photo) {
  const { method, url, token } = await own("/token");
  const body = new FormData();
  body.append("images", photo);
  // The same key for each sending: an attempt whose answer is lost is not lost with it.
  const headers = { Authorization: `Bearer ${token}`, "Idempotency-Key": crypto.randomUUID() };
  const send = () => fetch(url, { method, body, headers });
  const { error } = await send().catch(send).then((answer) => answer.json());
  // An earlier sending may have arrived, and only its answer be lost: the server asks what came of it.
  const arrived = ["replayed", "idempotency_conflict"].includes(error?.code);
  if (error && !arrived) throw new Error(error.message);
}

form.addEventListener("submit", async (event) => {
  event.preventDefault();
  const { name, password, photo } = Object.fromEntries(new FormData(form));
  output.value = "…";
  try {
    await own(event.submitter.value, { name, password });
    await show(photo);
    const { accepted } = await own("/face"); // what the server learned itself
    output.value = accepted ? `Welcome, ${name}` : "This is somebody else";
  } catch (error) {
    output.value = error.message;
  }
});
