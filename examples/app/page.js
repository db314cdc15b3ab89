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
  const send = () => fetch(url, { method, body, headers }).then((answer) => answer.json());
  let told = await send().catch(send);
  // An earlier sending is still at work: before it is done, nobody knows what comes of it.
  const end = Date.now() + 120_000; // no token lives longer
  while (told.error?.code === "idempotency_conflict" && Date.now() < end) {
    await new Promise((resolve) => setTimeout(resolve, 1000));
    told = await send().catch(send);
  }
  // Of one whose answer was lost the token is used up: the server asks what came of it.
  if (told.error && told.error.code !== "replayed") throw new Error(told.error.message);
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
