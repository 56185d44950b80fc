//! Records as the log stores them.
#![no_main]

use libfuzzer_sys::fuzz_target;
use wayfold_server::log::fuzzing;

fuzz_target!(|bytes: &[u8]| fuzzing::record(bytes));
