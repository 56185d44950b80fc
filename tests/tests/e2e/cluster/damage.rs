//! Damage to the store of a server of NATS, which is stopped.

use std::{
    fs,
    os::unix::fs::FileExt,
    path::{Path, PathBuf},
};

use rand::{Rng, RngExt, seq::IndexedRandom};

use super::disk::files;

/// The maximum number of bits to flip at once.
const MAX_FLIPS: usize = 30;

/// Flips bits of the messages that NATS stores: those of the streams, and the log by which its servers agree on them.
pub(super) fn flip_bits(store: &Path, random: &mut impl Rng) -> String {
    let files = blocks(store);
    let flips = random.random_range(1..=MAX_FLIPS);
    for _ in 0..flips {
        let path = files.choose(random).unwrap();
        let file = fs::File::options()
            .read(true)
            .write(true)
            .open(path)
            .unwrap();
        let bytes = file.metadata().unwrap().len();
        // Half of them in the newest part.
        let first = if random.random_bool(0.5) {
            0
        } else {
            bytes - bytes.div_ceil(4)
        };
        let at = random.random_range(first..bytes);
        let mut byte = [0];
        file.read_exact_at(&mut byte, at).unwrap();
        byte[0] ^= 1 << random.random_range(0..8);
        file.write_all_at(&byte, at).unwrap();
    }
    format!("{flips} bits of {} files", files.len())
}

/// Cuts one of the files with messages short.
pub(super) fn cut_file(store: &Path, random: &mut impl Rng) -> String {
    let files = blocks(store);
    let path = files.choose(random).unwrap();
    let file = fs::File::options().write(true).open(path).unwrap();
    let bytes = file.metadata().unwrap().len();
    let kept = random.random_range(0..bytes);
    file.set_len(kept).unwrap();
    let name = path.strip_prefix(store).unwrap().display();
    format!("{kept} of {bytes} bytes of {name} left")
}

/// The files with messages that are not empty.
fn blocks(store: &Path) -> Vec<PathBuf> {
    let mut files = files(store);
    files.retain(|path| {
        path.extension().is_some_and(|it| it == "blk") && fs::metadata(path).unwrap().len() > 0
    });
    assert!(!files.is_empty(), "NATS stores nothing in {store:?}");
    files
}
