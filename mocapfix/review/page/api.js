// Requests to the server of the review.

export class RequestError extends Error {
  constructor(message, status, body) {
    super(message);
    this.status = status;
    this.body = body;
  }
}

async function request(path, options = {}) {
  let response;
  try {
    response = await fetch(`api/${path}`, options);
  } catch {
    throw new RequestError("The review does not answer. Is it still running?", 0, null);
  }
  if (!response.ok) {
    let body = null;
    try { body = await response.json(); } catch { /* no JSON */ }
    throw new RequestError(body?.error ?? `The review answered with status ${response.status}.`, response.status, body);
  }
  return response;
}

const takePath = (id) => `takes/${id.split("/").map(encodeURIComponent).join("/")}`;

async function post(path, body) {
  const response = await request(path, { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(body) });
  return response.json();
}

export const fetchSession = async () => (await request("session")).json();
export const fetchTake = async (id) => (await request(takePath(id))).json();
export const fetchSamples = async (id, first, count) =>
  (await request(`${takePath(id)}/samples?first=${first}&count=${count}`)).arrayBuffer();
export const fetchTrace = async (id, marker) => (await request(`${takePath(id)}/trace?marker=${encodeURIComponent(marker)}`)).arrayBuffer();
export const fetchFills = async (id, marker, first, last) =>
  (await request(`${takePath(id)}/fills?marker=${encodeURIComponent(marker)}&first=${first}&last=${last}`)).json();
export const getCharacterUrl = (id, name) => `api/${takePath(id)}/characters?name=${encodeURIComponent(name)}`;
export const sendEdit = (id, revision, action) => post(`${takePath(id)}/edit`, { revision, action });
export const startCleaning = (id, options) => post(`${takePath(id)}/clean`, options);
export const cancelCleaning = (id) => post(`${takePath(id)}/cancel`, {});
export const approveTake = (id, name) => post(`${takePath(id)}/approve`, { name });
export const closeReview = () => post("close", {});

// Calls receive(event) for every event, and report(isConnected) when the stream opens or is lost.
export function followEvents(receive, report) {
  const source = new EventSource("api/events");
  source.onopen = () => report(true);
  source.onerror = () => report(false);
  source.onmessage = (message) => receive(JSON.parse(message.data));
  return source;
}
