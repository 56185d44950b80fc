//! The files of snapshots: their names, which hold the time, the uid and the revision, and their end.

use std::{fs, io, path::Path, time::SystemTime};

use time::OffsetDateTime;
use tracing::warn;

/// The end of the name of a snapshot.
pub(super) const SUFFIX: &str = ".snapshot";

/// The length of a time such as `20260131T235959Z`.
pub(super) const STAMP_BYTES: usize = 16;

/// Removes the oldest snapshots of an index. Those of other uids are of a deleted index of the name, or of a history that
/// this one lost.
pub(super) fn prune(directory: &Path, uid: &str, keep: usize) {
    let uid = format!("-{uid}-");
    // The snapshot that was just written is safe without this.
    let all = snapshots(directory).unwrap_or_default();
    let (mut own, others): (Vec<_>, Vec<_>) = all.into_iter().partition(|name| name.contains(&uid));
    // The clock may have been ahead, and revisions only grow.
    own.sort_by_key(|name| revision(name));
    for names in [own, others] {
        let old = names.len().saturating_sub(keep);
        for file in names.iter().take(old).map(|name| directory.join(name)) {
            match fs::remove_file(&file) {
                Err(error) if error.kind() != io::ErrorKind::NotFound => {
                    warn!(file = %file.display(), %error, "cannot remove an old snapshot");
                }
                _ => {}
            }
        }
    }
}

/// A time in UTC, by which names sort.
pub(super) fn stamp(at: SystemTime) -> String {
    let at = OffsetDateTime::from(at);
    let (date, time) = (at.date(), at.time());
    format!(
        "{:04}{:02}{:02}T{:02}{:02}{:02}Z",
        date.year(),
        u8::from(date.month()),
        date.day(),
        time.hour(),
        time.minute(),
        time.second()
    )
}

/// The names of the snapshots in a directory, the oldest first. Other files do not count.
pub(super) fn snapshots(directory: &Path) -> io::Result<Vec<String>> {
    let mut names = Vec::new();
    for entry in fs::read_dir(directory)? {
        let name = entry?.file_name().into_string();
        names.extend(name.ok().filter(|name| is_snapshot(name)));
    }
    names.sort_unstable();
    Ok(names)
}

/// The revision in the name of a snapshot; 0 if there is none.
fn revision(name: &str) -> u64 {
    let content = name.strip_suffix(SUFFIX).unwrap_or(name);
    let number = content.rsplit_once('-').map_or("", |(_, number)| number);
    number.parse().unwrap_or(0)
}

fn is_snapshot(name: &str) -> bool {
    let Some((stamped, content)) = name.split_at_checked(STAMP_BYTES) else {
        return false;
    };
    let form = stamped.bytes().enumerate().all(|(at, byte)| match at {
        8 => byte == b'T',
        15 => byte == b'Z',
        _ => byte.is_ascii_digit(),
    });
    form && content.starts_with('-') && content.ends_with(SUFFIX)
}

#[cfg(test)]
mod tests {
    use std::{fs::File, time::Duration};

    use super::*;

    #[test]
    fn names_have_the_time_in_utc() {
        let at = SystemTime::UNIX_EPOCH + Duration::from_secs(1_769_903_999);
        assert_eq!(stamp(at), "20260131T235959Z");
    }

    #[test]
    fn a_clock_that_was_ahead_takes_the_place_of_no_later_revision() {
        let directory = tempfile::tempdir().unwrap();
        let names = [
            "20260129T000000Z-uid-1.snapshot",
            "20260130T000000Z-other-9.snapshot",
            "20260131T000000Z-uid-30.snapshot",
            "20990101T000000Z-uid-4.snapshot",
        ];
        // This one cannot be removed as a file.
        fs::create_dir(directory.path().join(names[0])).unwrap();
        for name in &names[1..] {
            File::create(directory.path().join(name)).unwrap();
        }
        prune(directory.path(), "uid", 1);
        assert_eq!(
            snapshots(directory.path()).unwrap(),
            [names[0], names[1], names[2]]
        );
    }

    #[test]
    fn files_of_others_are_no_snapshots() {
        let directory = tempfile::tempdir().unwrap();
        let names = [
            "20260131T235959Z-uid-2.snapshot",
            "20260130T235959Z-uid-1.snapshot",
            "20260131T235959Z-uid-3.part",
            "2026-01-31-before-the-upgrade.snapshot",
            "notes",
            "20260131T23595éZ-uid-3.snapshot",
        ];
        for name in names {
            File::create(directory.path().join(name)).unwrap();
        }
        assert_eq!(snapshots(directory.path()).unwrap(), [names[1], names[0]]);
    }
}
