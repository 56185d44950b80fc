//! Spaces as people type them: an accepted text is printed, read again and sent as the same space.
#![no_main]

use libfuzzer_sys::fuzz_target;
use wayfold_index::Space;
use wayfold_proto::space::{from_message, to_message};

fuzz_target!(|text: &str| {
    let Ok(space) = text.parse::<Space>() else {
        return;
    };
    let printed = space.to_string();
    assert_eq!(printed.parse(), Ok(space.clone()), "{printed}");
    assert_eq!(from_message(&to_message(&space)), Ok(space));
});
