// Size of the page, and whether it is wider than the window.
const page = document.documentElement;
const wide = page.scrollWidth > page.clientWidth ? "wider than the window" : "fits";
report(`${page.clientWidth} ${Math.ceil(page.getBoundingClientRect().height)} ${wide}`);
