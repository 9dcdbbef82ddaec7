"use strict";
(() => {
  const find = (id) => document.getElementById(id);
  const table = find("takes"), body = table.tBodies[0], heads = [...table.tHead.rows[0].cells];
  const all = [...body.rows].map((row) => ({ row, text: null, keys: [] }));
  const collator = new Intl.Collator("en", { numeric: true, sensitivity: "base" });
  const emptyColumn = heads.findIndex((head) => head.textContent === "Left empty");
  let matching = all, page = 0;

  const readNumber = (text) => parseFloat(text.replace(/,/g, ""));
  const getKey = (item, column, isNumber) => {
    if (item.keys[column] === undefined) {
      const text = item.row.cells[column].textContent;
      item.keys[column] = isNumber ? readNumber(text) : text;
    }
    return item.keys[column];
  };
  const getText = (item) => (item.text ??= item.row.textContent.toLowerCase());

  const show = () => {
    const size = Number(find("size").value);
    const pages = Math.max(1, Math.ceil(matching.length / size));
    page = Math.min(Math.max(page, 0), pages - 1);
    const first = page * size, last = Math.min(first + size, matching.length);
    body.replaceChildren(...matching.slice(first, last).map((item) => item.row));
    body.removeAttribute("class");
    find("previous").disabled = page === 0;
    find("next").disabled = page === pages - 1;
    const count = (number) => number.toLocaleString("en");
    find("shown").textContent = matching.length ? `${count(first + 1)} to ${count(last)} of ${count(matching.length)} rows` : "No take matches.";
  };

  const filter = () => {
    const words = find("filter").value.toLowerCase().split(/\s+/).filter(Boolean), status = find("status").value;
    matching = all.filter((item) => {
      if (status === "empty" ? !(readNumber(item.row.cells[emptyColumn].textContent) > 0) : status && item.row.cells[2].className !== status) return false;
      return words.every((word) => getText(item).includes(word));
    });
    page = 0;
    show();
  };

  const sort = (column) => {
    const head = heads[column], isNumber = head.hasAttribute("data-number");
    const descending = head.ariaSort ? head.ariaSort === "ascending" : isNumber;
    heads.forEach((each) => each.removeAttribute("aria-sort"));
    head.setAttribute("aria-sort", descending ? "descending" : "ascending");
    const sign = descending ? -1 : 1;
    all.sort((a, b) => {
      const one = getKey(a, column, isNumber), other = getKey(b, column, isNumber);
      if (!isNumber) return sign * collator.compare(one, other);
      if (isNaN(one) || isNaN(other)) return isNaN(one) - isNaN(other);
      return sign * (one - other);
    });
    filter();
  };

  heads.forEach((head, column) => {
    if (head.hasAttribute("data-unsorted")) return;
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = head.textContent;
    button.addEventListener("click", () => sort(column));
    head.replaceChildren(button);
  });
  find("filter").addEventListener("input", filter);
  for (const id of ["status", "size"]) find(id).addEventListener("change", filter);
  find("previous").addEventListener("click", () => { page -= 1; show(); });
  find("next").addEventListener("click", () => { page += 1; show(); });
  find("tools").hidden = false;
  show();
})();
