//! The faults under the writers.

use std::collections::BTreeSet;

use clap::ValueEnum;
use rand::{Rng, RngExt, seq::IndexedRandom};

use super::clock::DAY;

/// A fault.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(super) enum Fault {
    /// A server is killed, and started again once writing has gone on without it.
    Kill,
    /// A server is killed and loses its data directory.
    Lose,
    /// A server stands still for as long as writing goes on without it, and for longer than the lease.
    Pause,
    /// A server of NATS is killed.
    KillNats,
    /// A server of NATS stands still, and its connections stay open.
    PauseNats,
    /// All servers of both kinds are killed at once.
    KillAll,
    /// The time of day of a server jumps by up to a day.
    Clock,
    /// Bits flip in the store of a server of NATS.
    Flip,
    /// A file in the store of a server of NATS is cut short.
    Cut,
    /// A server of NATS loses its power.
    PowerNats,
    /// All servers of NATS lose their power at once.
    PowerAllNats,
    /// A server and the server of NATS beside it lose their power.
    PowerBoth,
    /// The disk of a server is full.
    Full,
    /// The disk of a server of NATS is full.
    FullNats,
    /// A server reaches no other and no server of NATS. Clients reach all servers.
    CutServer,
    /// The same for the owner of the index.
    CutOwner,
    /// A server of NATS reaches no other server.
    CutNats,
    /// A server and a server of NATS reach each other and no others. Clients reach all servers.
    CutMinority,
    /// No client reaches a server, which reaches all others.
    CutFront,
    /// No client reaches any server.
    CutClients,
}

/// The needs of a fault beyond the programs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Needs {
    Nothing,
    /// A file system to mount for each server.
    Disks,
    /// A network namespace for each server.
    Network,
}

/// The part of a round in which writing stopped.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Stall {
    Before,
    Under,
    After,
}

impl Fault {
    pub(super) fn needs(self) -> Needs {
        match self {
            Fault::Kill
            | Fault::Lose
            | Fault::Pause
            | Fault::KillNats
            | Fault::PauseNats
            | Fault::KillAll
            | Fault::Clock
            | Fault::Flip
            | Fault::Cut => Needs::Nothing,
            Fault::PowerNats
            | Fault::PowerAllNats
            | Fault::PowerBoth
            | Fault::Full
            | Fault::FullNats => Needs::Disks,
            Fault::CutServer
            | Fault::CutOwner
            | Fault::CutNats
            | Fault::CutMinority
            | Fault::CutFront
            | Fault::CutClients => Needs::Network,
        }
    }

    /// True if it may leave damage in the store of a server of NATS.
    pub(super) fn damages_nats(self) -> bool {
        matches!(
            self,
            Fault::Flip | Fault::Cut | Fault::PowerNats | Fault::PowerBoth
        )
    }

    /// True if a server of NATS is away during the fault.
    pub(super) fn takes_nats(self) -> bool {
        use Fault::{CutMinority, CutNats, FullNats, KillNats, PauseNats};
        self.damages_nats()
            || matches!(
                self,
                KillNats | PauseNats | FullNats | CutNats | CutMinority
            )
    }

    /// True if NATS may stall under this fault: it is without one server, and the store of another one is damaged, so two of three
    /// copies are no majority.
    pub(super) fn excuses(self, stall: Stall, of: usize, damaged: &BTreeSet<usize>) -> bool {
        // A cut chooses its server of NATS itself.
        let is_other = |it: &usize| *it != of || self.needs() == Needs::Network;
        stall == Stall::Under && self.takes_nats() && damaged.iter().any(is_other)
    }

    /// The faults of a list of their names, or of one of the words `plain` (without root), `disks`, `partitions`, `all`.
    pub(super) fn parse(list: &str) -> Vec<Self> {
        let named = |name: &str| {
            let kinds = Self::value_variants().iter().filter(|fault| match name {
                "all" => true,
                "plain" => fault.needs() == Needs::Nothing,
                "disks" => fault.needs() == Needs::Disks,
                "partitions" => fault.needs() == Needs::Network,
                name => format!("{fault:?}").eq_ignore_ascii_case(name),
            });
            let kinds: Vec<_> = kinds.copied().collect();
            assert!(
                !kinds.is_empty(),
                "no fault is {name:?}: {:?}",
                Self::value_variants()
            );
            kinds
        };
        list.split(',').flat_map(named).collect()
    }

    /// The fault of a number: the first are one of each kind.
    pub(super) fn of(number: u64, kinds: &[Self], random: &mut impl Rng) -> Self {
        match usize::try_from(number).ok().and_then(|at| kinds.get(at)) {
            Some(fault) => *fault,
            None => *kinds.choose(random).expect("a kind"),
        }
    }
}

/// A jump of up to a day in either direction, in nanoseconds.
pub(super) fn jump(random: &mut impl Rng) -> i64 {
    random.random_range(-DAY..=DAY)
}

#[test]
fn only_a_stall_under_a_fault_that_takes_a_majority_is_excused() {
    let damaged = BTreeSet::from([1]);
    for fault in Fault::value_variants() {
        for stall in [Stall::Before, Stall::After] {
            assert!(!fault.excuses(stall, 0, &damaged), "{fault:?}");
        }
        assert!(!fault.excuses(Stall::Under, 0, &BTreeSet::new()));
        let takes_nats = fault.takes_nats();
        assert_eq!(fault.excuses(Stall::Under, 0, &damaged), takes_nats);
    }
    assert!(!Fault::KillNats.excuses(Stall::Under, 1, &damaged));
    assert!(Fault::CutNats.excuses(Stall::Under, 1, &damaged));
}
