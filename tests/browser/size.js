// Size of the page, and what is wider than the window: the page, a picture, or on a desktop a table in its frame.
const page = document.documentElement;
const scrolls = (it) => it.scrollWidth > it.clientWidth;
const tooWide = (it) => it.getBoundingClientRect().right > page.clientWidth || scrolls(it.parentElement);
const wide = [];
if (scrolls(page)) wide.push("page");
for (const it of document.querySelectorAll("img, canvas")) if (tooWide(it)) wide.push(it.alt || it.tagName);
if (page.clientWidth > 1000)
  for (const it of document.querySelectorAll(".wide")) if (scrolls(it)) wide.push(it.querySelector("table").id);
const seen = wide.length ? `wider than the window: ${wide.join(", ")}` : "fits";
report(`${page.clientWidth} ${Math.ceil(page.getBoundingClientRect().height)} ${seen}`);
