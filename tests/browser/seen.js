// How large the page is, and what reaches beyond its right edge.
const page = document.documentElement;
const wide = page.scrollWidth > page.clientWidth ? "wider than the window" : "fits";
said(`${page.clientWidth} ${Math.ceil(page.getBoundingClientRect().height)} ${wide}`);
