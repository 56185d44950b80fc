// The start of the page: the streams, and the route in the address.
//
// `#/` is the overview, `#/arm` the points of an index, and `#/start,goal` those of several in one picture.

import { IndexPage } from "./index_page.js";
import { show as showOverview } from "./overview.js";
import { start } from "./overview_feed.js";

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
  const names = hash.replace(/^#\/?/, "").split(",");
  // The names of indices need no encoding, so what is not decodable is no name.
  return [...new Set(names.filter((name) => /^[a-z0-9][a-z0-9_-]*$/.test(name)))];
}

window.addEventListener("hashchange", route);
start();
route();
