//! Spaces as messages: an accepted space is sent, printed and read again as the same space.
#![no_main]

use libfuzzer_sys::fuzz_target;
use prost::Message;
use wayfold_proto::{
    space::{from_message, to_message},
    v1,
};

fuzz_target!(|bytes: &[u8]| {
    let Ok(message) = v1::Space::decode(bytes) else {
        return;
    };
    let Ok(space) = from_message(&message) else {
        return;
    };
    assert_eq!(from_message(&to_message(&space)), Ok(space.clone()));
    let printed = space.to_string();
    assert_eq!(printed.parse(), Ok(space), "{printed}");
});
