/** Requests to the server of the review. All addresses are relative to the page. */

/** The server refused a request; the message is its sentence. */
export class RefusedError extends Error {
  constructor(message, status, take) {
    super(message);
    this.status = status;
    this.take = take;
  }
}

/** The server did not answer. */
export class LostError extends Error {}

export const getSession = () => request("api/session");
export const getTake = (id) => request(locateTake(id));
export const postEdit = (id, revision, action) => request(`${locateTake(id)}/edit`, { revision, action });
export const startCleaning = (id, formats, rigs) => request(`${locateTake(id)}/clean`, { formats, rigs });
export const cancelCleaning = (id) => request(`${locateTake(id)}/cancel`, {});
export const approveTake = (id, name) => request(`${locateTake(id)}/approve`, { name });
export const withdrawApproval = (id) => request(`${locateTake(id)}/withdraw`, {});
export const closeReview = () => request("api/close", {});

export async function getSamples(id, first, count) {
  const response = await send(`${locateTake(id)}/samples?first=${first}&count=${count}`);
  try {
    return await response.arrayBuffer();
  } catch {
    throw new LostError("The connection to the server is lost.");
  }
}

function locateTake(id) {
  return `api/takes/${encodeURIComponent(id)}`;
}

async function request(path, body) {
  const response = await send(path, body);
  try {
    return await response.json();
  } catch {
    throw new LostError("The answer of the server is incomplete.");
  }
}

async function send(path, body) {
  const options = { cache: "no-store" };
  if (body !== undefined) {
    Object.assign(options, { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(body) });
  }
  let response;
  try {
    response = await fetch(path, options);
  } catch {
    throw new LostError("The server does not answer.");
  }
  if (response.ok) return response;
  let answer = {};
  try {
    answer = await response.json();
  } catch {
    // an error without JSON has no sentence of its own
  }
  throw new RefusedError(answer.error || `The server refused the request (${response.status}).`, response.status, answer.take);
}
