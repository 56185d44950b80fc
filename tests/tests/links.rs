//! The pages of the repository: every relative link leads somewhere, and the README stays short.

#![expect(
    clippy::unwrap_used,
    reason = "a test says what went wrong by where it panics"
)]

use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
};

/// The maximum number of words of the README outside code and tables.
const MAX_README_WORDS: usize = 1_500;
/// The maximum number of rows of a table in the README.
const MAX_README_ROWS: usize = 8;

fn root() -> PathBuf {
    let tests = Path::new(env!("CARGO_MANIFEST_DIR"));
    tests.parent().unwrap().to_owned()
}

/// Collects all pages below `directory`, except in hidden directories and in the output of builds.
fn collect(directory: &Path, pages: &mut Vec<PathBuf>) {
    for entry in fs::read_dir(directory).unwrap() {
        let path = entry.unwrap().path();
        let name = path.file_name().unwrap().to_str().unwrap_or(".");
        let is_skipped = name.starts_with('.') || name == "target" || name == "wayfold-data";
        if path.is_dir() && !path.is_symlink() && !is_skipped {
            collect(&path, pages);
        } else if path.extension().is_some_and(|extension| extension == "md") {
            pages.push(path);
        }
    }
}

/// The lines outside fenced code.
fn prose(text: &str) -> impl Iterator<Item = &str> {
    text.lines().scan(false, |is_code, line| {
        let is_fence = line.trim_start().starts_with("```");
        *is_code ^= is_fence;
        Some(if *is_code || is_fence { "" } else { line })
    })
}

/// The targets of the inline links and pictures of a line.
fn targets(line: &str) -> impl Iterator<Item = &str> {
    let after = line.split("](").skip(1);
    after.filter_map(|rest| rest.split_once(')').map(|(target, _)| target))
}

/// The anchors that a forge gives the headings of a page.
fn anchors(text: &str) -> Vec<String> {
    let mut seen: BTreeMap<String, usize> = BTreeMap::new();
    let headings = prose(text).filter(|line| line.starts_with('#'));
    let slugs = headings.map(|line| {
        let title = line.trim_start_matches('#').trim().to_lowercase();
        let kept = title
            .chars()
            .filter(|c| c.is_alphanumeric() || " -_".contains(*c));
        let slug: String = kept.map(|c| if c == ' ' { '-' } else { c }).collect();
        let count = seen.entry(slug.clone()).or_default();
        *count += 1;
        match *count {
            1 => slug,
            count => format!("{slug}-{}", count - 1),
        }
    });
    slugs.collect()
}

#[test]
fn every_relative_link_leads_somewhere() {
    let mut pages = Vec::new();
    collect(&root(), &mut pages);
    assert!(pages.len() > 5, "{pages:?}");
    let mut broken = Vec::new();
    for page in &pages {
        let text = fs::read_to_string(page).unwrap();
        for target in prose(&text).flat_map(targets) {
            if target.contains("://") || target.starts_with("mailto:") {
                continue;
            }
            let (file, anchor) = target.split_once('#').unwrap_or((target, ""));
            let file = match file {
                "" => page.clone(),
                file => page.parent().unwrap().join(file),
            };
            let has_anchor = || {
                let there = fs::read_to_string(&file).unwrap_or_default();
                anchors(&there).iter().any(|known| known == anchor)
            };
            let is_found = file.exists() && (anchor.is_empty() || has_anchor());
            if !is_found {
                broken.push(format!("{}: {target}", page.display()));
            }
        }
    }
    assert!(broken.is_empty(), "{broken:#?}");
}

#[test]
fn a_page_says_first_whom_it_is_for() {
    let mut pages = Vec::new();
    collect(&root().join("docs"), &mut pages);
    for path in pages {
        let text = fs::read_to_string(&path).unwrap();
        let mut lines = text.lines().filter(|line| !line.is_empty());
        assert!(lines.next().unwrap().starts_with("# "), "{path:?}");
        assert!(lines.next().unwrap().starts_with("For "), "{path:?}");
    }
}

#[test]
fn the_readme_stays_short() {
    let text = fs::read_to_string(root().join("README.md")).unwrap();
    let sentences = prose(&text).filter(|line| !line.starts_with('|'));
    let words = sentences.flat_map(str::split_whitespace);
    let words = words.filter(|word| word.contains(char::is_alphanumeric));
    let count = words.count();
    assert!(count <= MAX_README_WORDS, "{count} words");

    let mut lines = 0;
    for line in prose(&text) {
        lines = if line.starts_with('|') { lines + 1 } else { 0 };
        assert!(lines <= MAX_README_ROWS + 2, "a long table ends in {line}");
    }
}
