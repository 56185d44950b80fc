// The start of the page: the streams, and the route in the address.
//
// `#/` is the overview, `#/arm` the points of an index, and `#/start,goal` those of several in one picture.

import { forget, report } from "./connection.js";
import { byId } from "./dom.js";
import { IndexPage } from "./index_page.js";
import { show as showOverview } from "./overview.js";
import { start } from "./overview_feed.js";

const ADDRESS = "address";

// Ends the shown view.
let leave = () => {};
// The page of indices while it is shown: another index joins it without a new picture.
let indexPage = null;

function route() {
  const names = namesIn(location.hash);
  if (indexPage && names.length > 0) {
    indexPage.show(names);
    return;
  }
  leave();
  indexPage = null;
  if (names.length === 0) {
    leave = showOverview();
  } else {
    indexPage = new IndexPage();
    const page = indexPage;
    leave = () => page.close();
    page.show(names);
  }
  window.scrollTo(0, 0);
}

function namesIn(hash) {
  const requested = hash.replace(/^#\//, "").split(",").filter(Boolean);
  // The names of indices need no encoding.
  const isName = (name) => /^[a-z0-9][a-z0-9_-]*$/.test(name);
  const others = requested.filter((name) => !isName(name));
  if (others.length > 0) report(ADDRESS, "live", `No index has the name ${others.join(", ")}: names have a to z, 0 to 9, _ and -.`);
  else forget(ADDRESS);
  return [...new Set(requested.filter(isName))];
}

window.addEventListener("hashchange", () => {
  const before = leave;
  route();
  // The link that was followed may be hidden now, and would take the focus with it.
  if (leave !== before) byId("content").focus({ preventScroll: true });
});
// The address names the view, so the skip link leaves it alone.
document.querySelector(".skip").addEventListener("click", (event) => {
  event.preventDefault();
  byId("content").focus();
});
start();
route();
