//! A planner with a shared index: `copy-process URI INDEX`.
//!
//! For each line of standard input, a number, it inserts that many points, waits until the server has them and the copy follows,
//! and prints the number of points in the copy.

use std::{
    env,
    io::{self, BufRead},
    time::Duration,
};

use wayfold::{ConnectionStatus, Index};
use wayfold_tests::States;

fn main() {
    let arguments: Vec<String> = env::args().skip(1).collect();
    let [uri, index] = arguments.as_slice() else {
        panic!("usage: copy-process URI INDEX");
    };
    let index = Index::shared(uri, index).timeout(Duration::from_secs(60));
    let index = index.open().expect("an index");
    let mut states = States::new(index.space().clone(), 5);
    println!("ready");
    for line in io::stdin().lock().lines() {
        let count: usize = line.expect("a line").parse().expect("a number");
        for _ in 0..count {
            index.insert(&states.row()[..]).expect("an insert");
        }
        index.flush().expect("an acknowledgement");
        while !matches!(
            index.status(),
            Some(ConnectionStatus::Following { behind: 0 })
        ) {
            std::thread::yield_now();
        }
        println!("{}", index.len().expect("a copy"));
    }
}
