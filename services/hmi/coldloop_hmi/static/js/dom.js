// Elements of the page: found, made, and texts in them.

/**
 * The element of an id, which the page has.
 * @param {string} id
 * @returns {PageElement}
 */
export function byId(id) {
  return /** @type {any} */ (document.getElementById(id));
}

/**
 * The elements of a selector, within another one or the whole page.
 * @param {string} selector
 * @param {ParentNode} root
 * @returns {PageElement[]}
 */
export function elements(selector, root = document) {
  return [.../** @type {NodeListOf<any>} */ (root.querySelectorAll(selector))];
}

/**
 * @param {string} name
 * @param {Record<string, any>} attributes
 * @param {(Node | string)[]} children
 * @returns {any}
 */
export function element(name, attributes = {}, ...children) {
  const made = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (key === "text") made.textContent = value;
    else if (key.startsWith("on")) made.addEventListener(key.slice(2), value);
    else if (value === true) made.setAttribute(key, "");
    else if (value !== false && value !== undefined) made.setAttribute(key, value);
  }
  made.append(...children);
  return made;
}

const SVG = "http://www.w3.org/2000/svg";
/**
 * @param {string} name
 * @param {Record<string, any>} attributes
 * @param {string} [text]
 * @returns {SVGElement}
 */
export function shape(name, attributes = {}, text) {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  if (text !== undefined) made.textContent = text;
  return made;
}

/**
 * Text in which "tau_u" and "q_min" are set with an index.
 * @param {string} text
 * @returns {(Node | string)[]}
 */
export function indexed(text) {
  return text
    .replaceAll("tau_u", "τ_u")
    .split(/(_\{[^}]*\}|(?<=[A-Za-zτĴ⁺])_[A-Za-z]+)/)
    .filter(Boolean)
    .map((part) => (part[0] === "_" ? element("sub", { text: part.slice(1).replace(/[{}]/g, "") }) : part));
}
