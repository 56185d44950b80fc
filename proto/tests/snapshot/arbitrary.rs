//! Bytes and contents of any kind, and damage at any place.

use proptest::prelude::*;
use proptest::test_runner::RngSeed;
use wayfold_proto::snapshot::{Reader, Writer, check};

use super::{header, points, signed, whole};

proptest! {
    #![proptest_config(ProptestConfig {
        cases: 2000,
        failure_persistence: None,
        rng_seed: RngSeed::Fixed(7),
        ..ProptestConfig::default()
    })]

    #[test]
    fn arbitrary_bytes_are_refused(
        bytes in prop::collection::vec(any::<u8>(), 0..300),
        begins in any::<bool>(),
    ) {
        let line: &[u8] = if begins { b"wayfold snapshot 3\n" } else { b"" };
        prop_assert!(check(&[line, &bytes].concat()[..]).is_err());
    }

    /// The digest is good, so the reader decodes the content.
    #[test]
    fn arbitrary_contents_do_not_make_a_reader_panic(
        content in prop::collection::vec(any::<u8>(), 0..300),
    ) {
        prop_assert!(Reader::new().read(&signed(&[0; 32], 1, content)).is_err());
    }

    /// A good header, then a damaged part with a good digest.
    #[test]
    fn damaged_points_with_a_good_digest_do_not_make_a_reader_panic(
        at in any::<prop::sample::Index>(),
        bytes in prop::collection::vec(any::<u8>(), 1..8),
        cut in 0..8_usize,
    ) {
        let mut writer = Writer::new();
        let first = writer.header(&header(3));
        let mut content = writer.points(points(&[1, 5, 6])).content.to_vec();
        let start = at.index(content.len());
        for (place, byte) in content[start..].iter_mut().zip(bytes) {
            *place = byte;
        }
        content.truncate(content.len() - cut);
        let mut reader = Reader::new();
        reader.read(&first).unwrap();
        // Some of these parts are valid: they differ in a tag or a payload.
        let _ = reader.read(&signed(&first.digest, 2, content));
    }

    #[test]
    fn several_damaged_bytes_are_noticed(
        damage in prop::collection::vec((any::<prop::sample::Index>(), 1..=255_u8), 1..4),
    ) {
        let mut bytes = whole();
        for (at, change) in damage {
            let at = at.index(bytes.len());
            bytes[at] ^= change;
        }
        prop_assert!(bytes == whole() || check(&bytes[..]).is_err());
    }
}
