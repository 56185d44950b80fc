//! The files of the page, in the program: plain modules without a build step, so that the page works offline and its next
//! reader needs no tool.

use axum::{
    Router,
    http::{HeaderName, header},
    routing::get,
};

/// The files by their names.
macro_rules! files {
    ($($name:literal),* $(,)?) => {
        [$(($name, include_str!(concat!("page/", $name)))),*]
    };
}

static FILES: [(&str, &str); 56] = files![
    "addresses.js",
    "answer.js",
    "api.js",
    "app.js",
    "axes.js",
    "bounds.js",
    "camera.js",
    "cloud.js",
    "columns.js",
    "connection.js",
    "dom.js",
    "edges.js",
    "format.js",
    "frames.js",
    "gestures.js",
    "history.js",
    "icon.svg",
    "id_map.js",
    "index.html",
    "index_page.js",
    "layer.js",
    "line_renderer.js",
    "line_sample.js",
    "lost.js",
    "marks.js",
    "metric.js",
    "metrics.js",
    "overview.js",
    "overview_feed.js",
    "pacer.js",
    "palette.js",
    "parallel.js",
    "parallel_axes.js",
    "pauses.js",
    "picker.js",
    "picture.css",
    "picture.js",
    "probe.js",
    "program.js",
    "projections.js",
    "renderer.js",
    "replay.js",
    "shaders.js",
    "share.js",
    "sign_in.js",
    "snippets.js",
    "space.js",
    "sparkline.js",
    "spatial.js",
    "stream.js",
    "style.css",
    "ticks.js",
    "timeline.js",
    "vertices.js",
    "view_panel.js",
    "waiting.js",
];

/// The page runs and shows only files of this server, and asks only this server. No other page embeds it.
const HEADERS: [(HeaderName, &str); 5] = [
    (
        header::CONTENT_SECURITY_POLICY,
        "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src 'self'; base-uri 'none'; \
         form-action 'none'; frame-ancestors 'none'",
    ),
    (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
    (header::REFERRER_POLICY, "no-referrer"),
    // The next start may have another version of them.
    (header::CACHE_CONTROL, "no-cache"),
    (
        HeaderName::from_static("cross-origin-opener-policy"),
        "same-origin",
    ),
];

/// The routes of the files; that of `index.html` is `/`.
pub(super) fn routes() -> Router {
    FILES.iter().fold(Router::new(), |router, (name, text)| {
        let answer = move || async move { (HEADERS, [(header::CONTENT_TYPE, media(name))], *text) };
        let path = format!("/{}", name.trim_start_matches("index.html"));
        router.route(&path, get(answer))
    })
}

fn media(name: &str) -> &'static str {
    match name.rsplit('.').next() {
        Some("html") => "text/html; charset=utf-8",
        Some("css") => "text/css; charset=utf-8",
        Some("svg") => "image/svg+xml",
        _ => "text/javascript; charset=utf-8",
    }
}

#[cfg(test)]
mod tests {
    use std::{fs, path::Path};

    use super::*;

    #[test]
    fn every_file_of_the_page_is_served() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("src/http/page");
        let mut names: Vec<String> = fs::read_dir(folder)
            .unwrap()
            .map(|file| file.unwrap().file_name().into_string().unwrap())
            .collect();
        names.sort();
        assert_eq!(names, FILES.map(|(name, _)| name));
    }
}
