//! A network namespace for each server, and two networks: the *back*, by which the servers reach each other and NATS, and
//! the *front*, by which clients reach servers. Each has two switches. A port that is moved to the other switch does not
//! reach those that stay, and neither side learns of it: packets are lost.
//!
//! The namespaces are in a network namespace of the test's own and in a private mount of `/run/netns`, which
//! `tests/cluster/run` makes. They end with the test.

use std::process::Command;

use wayfold_tests::nats::Host;

use super::disk::run;

/// One of the two networks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Side {
    Back,
    Front,
}

/// The place of the clients, which are in the namespace of this process.
pub(super) const CLIENTS: usize = 200;

/// The network of a number of servers and their clients.
pub(super) struct Network {
    places: usize,
}

impl Network {
    /// Makes the namespaces of these many places, and joins them.
    pub(super) fn new(places: usize) -> Self {
        ip("link set lo up");
        for side in [Side::Back, Side::Front] {
            for number in 0..2 {
                let switch = side.switch(number);
                ip(&format!("link add {switch} type bridge"));
                ip(&format!("link set {switch} up"));
            }
        }
        for place in 0..places {
            let namespace = namespace(place);
            ip(&format!("netns add {namespace}"));
            ip(&format!("-n {namespace} link set lo up"));
            for side in [Side::Back, Side::Front] {
                let end = side.plug_in(place);
                ip(&format!("link set {end} netns {namespace}"));
                side.set_address(&format!("-n {namespace} "), place, &end);
            }
        }
        let end = Side::Front.plug_in(CLIENTS);
        Side::Front.set_address("", CLIENTS, &end);
        Self { places }
    }

    /// The host at a place, in the back.
    pub(super) fn host(&self, place: usize) -> Host {
        assert!(place < self.places);
        // Unlike `ip netns exec` it makes no mount namespace, which would keep disks mounted.
        let net = format!("--net=/run/netns/{}", namespace(place));
        Host {
            address: Side::Back.address(place),
            enter: vec!["nsenter".into(), net],
        }
    }

    /// The address of a place for clients.
    pub(super) fn front(&self, place: usize) -> String {
        Side::Front.address(place)
    }

    /// Cuts these places off from the others. They reach each other.
    pub(super) fn cut(&self, side: Side, places: &[usize]) {
        for place in places {
            side.connect(*place, 1);
        }
    }

    /// Joins them again.
    pub(super) fn join(&self, side: Side, places: &[usize]) {
        for place in places {
            side.connect(*place, 0);
        }
    }
}

impl Drop for Network {
    fn drop(&mut self) {
        for side in [Side::Back, Side::Front] {
            for place in 0..self.places {
                // The other end goes too.
                ip(&format!("link delete {}", side.port(place)));
            }
            for number in 0..2 {
                ip(&format!("link delete {}", side.switch(number)));
            }
        }
        ip(&format!("link delete {}", Side::Front.port(CLIENTS)));
        for place in 0..self.places {
            ip(&format!("netns delete {}", namespace(place)));
        }
    }
}

impl Side {
    fn letter(self) -> char {
        match self {
            Side::Back => 'b',
            Side::Front => 'f',
        }
    }

    fn switch(self, number: usize) -> String {
        format!("switch-{}{number}", self.letter())
    }

    fn port(self, place: usize) -> String {
        format!("port-{}{place}", self.letter())
    }

    fn address(self, place: usize) -> String {
        let network = match self {
            Side::Back => 77,
            Side::Front => 78,
        };
        format!("10.{network}.0.{}", place + 1)
    }

    /// Makes the cable of a place; returns its free end.
    fn plug_in(self, place: usize) -> String {
        let (port, end) = (self.port(place), format!("end-{}{place}", self.letter()));
        ip(&format!("link add {port} type veth peer name {end}"));
        ip(&format!("link set {port} master {} up", self.switch(0)));
        end
    }

    fn set_address(self, namespace: &str, place: usize, end: &str) {
        let address = self.address(place);
        ip(&format!("{namespace}addr add {address}/24 dev {end}"));
        ip(&format!("{namespace}link set {end} up"));
    }

    fn connect(self, place: usize, switch: usize) {
        let (port, switch) = (self.port(place), self.switch(switch));
        ip(&format!("link set {port} master {switch}"));
    }
}

fn namespace(place: usize) -> String {
    format!("place-{place}")
}

fn ip(arguments: &str) {
    run(Command::new("ip").args(arguments.split(' ')));
}
