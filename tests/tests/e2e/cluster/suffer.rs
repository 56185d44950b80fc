//! Causes faults and repairs them.

use std::{future::pending, time::Duration};

use rand::{Rng, RngExt};
use tokio::time::timeout;
use wayfold_tests::Signal;

use super::{
    damage::{cut_file, flip_bits},
    fault::{Fault, jump},
    network::{CLIENTS, Side},
    servers::{Cluster, NATS_SERVERS, SERVERS},
};

/// Longer than a server that is silent counts as live.
const LONGER_THAN_LEASE: Duration = Duration::from_secs(3);

/// Lets the lease of a server that stands still or is cut off pass, under load.
async fn pass_lease() {
    let _ = timeout(LONGER_THAN_LEASE, pending::<()>()).await;
}

impl Cluster {
    /// Causes a fault, waits with `go_on` until writing has gone on, and repairs it. Returns the details.
    pub(super) async fn suffer(
        &mut self,
        fault: Fault,
        of: usize,
        random: &mut impl Rng,
        mut go_on: impl AsyncFnMut(),
    ) -> String {
        match fault {
            Fault::Kill => {
                self.kill(of);
                go_on().await;
                self.start_servers(&[of]);
            }
            Fault::Lose => {
                self.kill(of);
                self.lose_data(of);
                go_on().await;
                self.start_servers(&[of]);
            }
            Fault::Pause => {
                self.signal(of, Signal::Pause);
                go_on().await;
                pass_lease().await;
                self.signal(of, Signal::Resume);
            }
            Fault::KillNats => {
                self.kill_nats(of);
                go_on().await;
                self.nats.restart(of);
            }
            Fault::PauseNats => {
                self.nats.signal(of, Signal::Pause);
                go_on().await;
                pass_lease().await;
                self.nats.signal(of, Signal::Resume);
                go_on().await;
            }
            Fault::KillAll => {
                self.kill_all();
                go_on().await;
            }
            Fault::Clock => {
                let offset_ns = jump(random);
                self.clocks.jump(of, offset_ns);
                go_on().await;
                return format!("{} s ahead", offset_ns / 1_000_000_000);
            }
            Fault::Flip | Fault::Cut => {
                self.kill_nats(of);
                go_on().await;
                let store = self.nats.store(of);
                let what = match fault {
                    Fault::Flip => flip_bits(&store, random),
                    _ => cut_file(&store, random),
                };
                self.nats.restart(of);
                go_on().await;
                return what;
            }
            Fault::PowerNats | Fault::PowerAllNats | Fault::PowerBoth => {
                self.lose_power(fault, of, go_on).await;
            }
            Fault::Full => {
                self.disks[of].fill();
                go_on().await;
                pass_lease().await;
                self.disks[of].free();
            }
            Fault::FullNats => {
                let disk = &self.disks[SERVERS + of];
                disk.fill();
                go_on().await;
                pass_lease().await;
                disk.free();
                // If NATS has switched JetStream off there, a restart brings it back.
                self.kill_nats(of);
                self.nats.restart(of);
            }
            Fault::CutOwner => {
                let owner = self.owner().await;
                self.cut(fault, owner, random, go_on).await;
                return format!("server {owner}");
            }
            Fault::CutServer
            | Fault::CutNats
            | Fault::CutMinority
            | Fault::CutFront
            | Fault::CutClients => self.cut(fault, of, random, go_on).await,
        }
        String::new()
    }

    async fn lose_power(&mut self, fault: Fault, of: usize, mut go_on: impl AsyncFnMut()) {
        let nodes = match fault {
            Fault::PowerAllNats => 0..NATS_SERVERS,
            _ => of..of + 1,
        };
        let with_server = fault == Fault::PowerBoth;
        for node in nodes.clone() {
            self.nats.signal(node, Signal::Pause);
        }
        if with_server {
            self.signal(of, Signal::Pause);
            self.disks[of].lose_power();
            self.kill(of);
        }
        for node in nodes.clone() {
            self.disks[SERVERS + node].lose_power();
        }
        for node in nodes.clone() {
            self.kill_nats(node);
        }
        let is_all = nodes.len() == NATS_SERVERS;
        if !is_all {
            go_on().await;
        }
        for node in nodes {
            self.disks[SERVERS + node].regain_power();
            self.nats.restart(node);
        }
        if with_server {
            self.disks[of].regain_power();
            self.start_servers(&[of]);
        }
        if is_all {
            go_on().await;
        }
    }

    async fn cut(
        &mut self,
        fault: Fault,
        of: usize,
        random: &mut impl Rng,
        mut go_on: impl AsyncFnMut(),
    ) {
        let node = SERVERS + random.random_range(0..NATS_SERVERS);
        let (side, places) = match fault {
            Fault::CutServer | Fault::CutOwner => (Side::Back, vec![of]),
            Fault::CutNats => (Side::Back, vec![node]),
            Fault::CutMinority => (Side::Back, vec![of, node]),
            Fault::CutFront => (Side::Front, vec![of]),
            _ => (Side::Front, vec![CLIENTS]),
        };
        let network = self.network.as_ref().expect("a network");
        network.cut(side, &places);
        if fault != Fault::CutClients {
            go_on().await;
        }
        pass_lease().await;
        network.join(side, &places);
        go_on().await;
    }
}
