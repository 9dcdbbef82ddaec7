/** Building and finding elements. All text is set as text. */

export const find = (id) => document.getElementById(id);

export function build(tag, properties = {}, ...children) {
  const element = document.createElement(tag);
  const { data = {}, role, ariaSelected, ...others } = properties;
  Object.assign(element, others);
  if (role) element.setAttribute("role", role);
  if (ariaSelected) element.setAttribute("aria-selected", ariaSelected);
  Object.assign(element.dataset, data);
  element.append(...children);
  return element;
}

export function fillOptions(select, options, value = select.value) {
  select.replaceChildren(...options.map(([name, text]) => build("option", { value: name, textContent: text })));
  if (options.some(([name]) => name === value)) select.value = value;
}

export const formatMm = (value) => (value === null || value === undefined ? "–" : `${value.toFixed(1)} mm`);
export const count = (number, noun) => `${number.toLocaleString("en")} ${noun}${number === 1 ? "" : "s"}`;

/** Prefer what was stored in this browser; storage may be switched off. */
export function recall(key) {
  try {
    return localStorage.getItem(`mocapfix.${key}`);
  } catch {
    return null;
  }
}

export function remember(key, value) {
  try {
    localStorage.setItem(`mocapfix.${key}`, value);
  } catch {
    // the choice holds until the page is closed
  }
}
