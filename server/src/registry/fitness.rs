//! The fitness of a server of a cluster: while it is cut off from the journal, or cannot open its store, calls are better
//! made at another server.

use std::{
    sync::atomic::{AtomicU32, Ordering::Relaxed},
    time::Duration,
};

use tokio::{
    sync::watch,
    time::{MissedTickBehavior, interval},
};

use super::Registry;

/// The number of checks, one a second, that find the journal out of reach before callers are sent to another server.
/// The client of NATS connects again sooner than that if it can.
pub(crate) const MAX_CUT_OFF_CHECKS: u32 = 5;

/// The time between two checks.
const CHECK_INTERVAL: Duration = Duration::from_secs(1);

/// See the module.
pub(super) struct Fitness {
    /// The last checks in turn that found the journal out of reach.
    cut_off_checks: AtomicU32,
    is_fit: watch::Sender<bool>,
}

impl Default for Fitness {
    fn default() -> Self {
        Self {
            cut_off_checks: AtomicU32::new(0),
            is_fit: watch::Sender::new(true),
        }
    }
}

impl Registry {
    /// False while another server of a cluster answers better: this one has been cut off from the journal for
    /// [`MAX_CUT_OFF_CHECKS`], or its store is not open. [`Registry::keep_fitness`] looks.
    pub(crate) fn fitness(&self) -> watch::Receiver<bool> {
        self.note_fitness();
        self.fitness.is_fit.subscribe()
    }

    /// Looks each second, forever. The other work of [`Registry::maintain`] may take minutes.
    pub(crate) async fn keep_fitness(&self) {
        let mut ticks = interval(CHECK_INTERVAL);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            ticks.tick().await;
            self.check_fitness();
        }
    }

    /// Looks once more, a second after the last look.
    fn check_fitness(&self) {
        let before = self.fitness.cut_off_checks.load(Relaxed);
        let checks = match self.is_cut_off() {
            true => before.saturating_add(1),
            false => 0,
        };
        self.fitness.cut_off_checks.store(checks, Relaxed);
        self.note_fitness();
    }

    fn note_fitness(&self) {
        let is_cut_off = self.fitness.cut_off_checks.load(Relaxed) >= MAX_CUT_OFF_CHECKS;
        let is_fit = !is_cut_off && self.unopened().is_none();
        self.fitness.is_fit.send_if_modified(|known| {
            let is_changed = *known != is_fit;
            *known = is_fit;
            is_changed
        });
    }
}

#[cfg(test)]
mod tests {
    use std::{
        fs,
        sync::{Arc, atomic::AtomicBool},
    };

    use futures_util::{StreamExt, stream};

    use super::*;
    use crate::{
        log::{Durability, FjallLog, Journal, LogError, MemoryLog, RecordStream, Uid},
        registry::RegistryOptions,
        testing::{self, forward_journal, recorded},
    };

    /// A journal that other servers share.
    struct Remote {
        local: Arc<MemoryLog>,
        is_reachable: AtomicBool,
    }

    impl Journal for Remote {
        forward_journal!(local);

        fn follow(&self, _: Uid, _: u64) -> RecordStream {
            stream::pending().boxed()
        }

        fn newest(&self, uid: Uid) -> Result<u64, LogError> {
            self.local.newest(uid)
        }

        fn is_reachable(&self) -> bool {
            self.is_reachable.load(Relaxed)
        }
    }

    #[tokio::test]
    async fn a_server_is_unfit_once_it_has_been_cut_off_for_a_while() {
        let local = recorded(1);
        let journal = Arc::new(Remote {
            local: Arc::clone(&local),
            is_reachable: AtomicBool::new(false),
        });
        let registry = testing::registry(&journal, &local, RegistryOptions::default());
        let fitness = registry.fitness();
        for _ in 1..MAX_CUT_OFF_CHECKS {
            registry.check_fitness();
            assert!(*fitness.borrow());
        }
        registry.check_fitness();
        assert!(!*fitness.borrow());
        assert!(!*registry.fitness().borrow());
        journal.is_reachable.store(true, Relaxed);
        registry.check_fitness();
        assert!(*fitness.borrow());
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn a_server_is_unfit_while_its_store_is_not_open() {
        let [directory, elsewhere] = [(); 2].map(|()| tempfile::tempdir().unwrap());
        let (store, moved) = (
            directory.path().join("store"),
            elsewhere.path().join("store"),
        );
        let open = || FjallLog::open(directory.path(), Durability::Fsync).unwrap();
        drop(open());
        fs::rename(&store, &moved).unwrap();
        let registry = Registry::new(Arc::new(open()), RegistryOptions::default());
        registry.replay().unwrap();
        let fitness = registry.fitness();
        assert!(!*fitness.borrow());
        fs::rename(&moved, &store).unwrap();
        registry.recover().unwrap();
        registry.check_fitness();
        assert!(*fitness.borrow());
    }
}
