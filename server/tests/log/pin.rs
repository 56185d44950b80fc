//! The versions of fjall whose private layout the log relies on.
//!
//! Before the pin moves to another version, read how that version does each of the following, run the tests named here,
//! and then write its version below:
//!
//! - A batch goes to the largest of the files `N.jnl`; the one before is synced when the next is made. Relied on in
//!   `fjall/journal.rs`, checked by `a_synced_commit_is_in_the_newest_file`,
//!   `a_file_that_was_made_and_is_not_written_to_does_not_hide_the_one_before`.
//! - An entry of the journal never begins with a zero, and a damaged entry ends the journal in silence. Relied on in
//!   `fjall/journal.rs`, `fjall/sync_marks.rs`, checked by `log::lost`, `log::flips`.
//! - The entries of the journal byte for byte, uncompressed, and the XXH3 of a batch. A batch that decodes and has another
//!   checksum fails `open` with `ChecksumMismatch`, leaves the journal as it is, and unlocks the store. Relied on in
//!   `fjall/torn_batch.rs`, checked by its tests, `a_synced_revision_whose_sectors_are_lost_is_named`.
//! - The trees `keyspaces/0` and `keyspaces/1`, their files `vN`, and `current`: number, XXH3, kind. Relied on in
//!   `fjall/manifest.rs`, checked by `any_missing_part_of_a_store_is_named_and_nothing_else_is_touched`,
//!   `log::flips`.
//! - `current` is replaced after its list is synced, and older lists are removed later. Relied on in
//!   `fjall/manifest_copy.rs`, checked by `log::shared_files`.
//! - The content of the file `version`. Relied on in `fjall/manifest_copy.rs`, checked by `log::shared_files`.
//! - A keyspace that is poisoned says so in `persist`, and memtables and runs above its limits hold up a writer. Relied
//!   on in `fjall/store.rs`, checked by `log::rebuilt`, e2e `disk_failure`.
//! - Fjall refuses a block whose checksum does not match, in reads and in compactions. Relied on in `fjall/rebuild.rs`,
//!   checked by `log::rebuilt`, `log::flips`.
//! - A snapshot sees all that was committed before it, and pins what was overwritten since. Relied on in
//!   `fjall/view.rs`, checked by `a_view_stays_at_its_revision_when_its_index_is_written_and_deleted`,
//!   `views_are_never_torn`, service `idle_index`.
//! - A database that is dropped has ended its threads and writes nothing more. Relied on in `fjall/journal.rs`,
//!   `fjall/manifest_copy.rs`, checked by `a_start_rewrites_the_journal_unless_the_shutdown_was_clean`, e2e `power_loss`.
//! - `drop_range` drops the tables whose keys are all in a range, under the lock of the compactions, and a snapshot still
//!   reads them. The next rotation of the memtable lets go of their files. Relied on in `fjall/sweeper.rs`, checked by
//!   `a_deleted_index_gives_its_disk_back`.
//! - All keys in one keyspace reach the tables in the order of the journal. Relied on in `fjall/layout.rs`, checked by
//!   `the_log_on_disk_is_the_sum_of_its_records`, e2e `crash` and `power_loss`.

/// The versions for which the list above was checked.
const CHECKED: [(&str, &str); 2] = [("fjall", "3.1.13"), ("lsm-tree", "3.1.10")];

#[test]
fn the_locked_versions_of_fjall_are_the_checked_ones() {
    let lock = include_str!("../../../Cargo.lock");
    for (name, version) in CHECKED {
        let package = format!("\nname = \"{name}\"\nversion = \"");
        let locked: Vec<&str> = lock.split(&package).skip(1).collect();
        assert_eq!(locked.len(), 1, "{name} is locked once");
        assert!(
            locked[0].starts_with(&format!("{version}\"")),
            "{name} is not locked at {version}: check the list in this file"
        );
    }
}
