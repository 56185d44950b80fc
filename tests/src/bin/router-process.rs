//! A Zenoh router between a server and its clients: `router-process LOCATOR`.
//!
//! It prints its address, and ends when its standard input ends.

use std::{
    env,
    io::{self, Read},
};

use serde_json::json;
use zenoh::{Config, Wait};

fn main() {
    let locator = env::args().nth(1).expect("router-process LOCATOR");
    let config = json!({
        "mode": "router",
        "listen": { "endpoints": [locator] },
        "scouting": { "multicast": { "enabled": false }, "gossip": { "enabled": false } },
    });
    let config = Config::from_json5(&config.to_string()).expect("a configuration");
    let session = zenoh::open(config).wait().expect("a session");
    let locators = session.info().locators().wait();
    println!("{}", locators.first().expect("a listener"));
    let mut nothing = Vec::new();
    io::stdin().read_to_end(&mut nothing).expect("a pipe");
}
