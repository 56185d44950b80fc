//! Operations written by hand, one for each kind of fault.

use wayfold_proto::v1::{self, create_index_request::SpaceForm};

use super::{op::Op, outcome::UID, sessions};

/// The number of handwritten operations that come after the random ones.
pub(crate) const AFTER: usize = 8;

pub(crate) fn by_hand() -> Vec<Op> {
    let create = |name: &str, space: &str| {
        Op::Create(v1::CreateIndexRequest {
            name: name.into(),
            space_form: Some(SpaceForm::SpaceText(space.into())),
            ..Default::default()
        })
    };
    let so3 = |name: &str| {
        let so3 = v1::space::Kind::So3(v1::So3 {});
        let so3 = v1::Space { kind: Some(so3) };
        Op::Create(v1::CreateIndexRequest {
            name: name.into(),
            space_form: Some(SpaceForm::Space(so3)),
            ..Default::default()
        })
    };
    let spaceless = Op::Create(v1::CreateIndexRequest {
        name: "hand".into(),
        space_form: None,
        ..Default::default()
    });
    let list = |page_size, page_token: &str| {
        Op::List(v1::ListIndexesRequest {
            page_size,
            page_token: page_token.into(),
        })
    };
    let delete = |name: &str, uid: &str| {
        Op::Delete(v1::DeleteIndexRequest {
            index_name: name.into(),
            uid: uid.into(),
        })
    };
    let info = |name: &str| {
        Op::Info(v1::GetIndexRequest {
            index_name: name.into(),
        })
    };
    let insert = |ids: &[u64], operation_id: &str, payload: usize| {
        Op::Insert(v1::InsertRequest {
            index_name: "arm".into(),
            states: Some(v1::States {
                row_count: 1,
                coordinates: vec![0.1, 0.2, 0.3, 0.6, 0.8],
            }),
            ids: ids.into(),
            payloads: vec![vec![7; payload].into()],
            operation_id: operation_id.into(),
            ..Default::default()
        })
    };
    let mut ops = vec![
        info("arm"),
        list(0, ""),
        create("arm", "R1*SO2*R3:0.5"),
        create("arm", "R1*SO2*R3:0.5"),
        create("arm", "R5"),
        create("Arm", "R5"),
        create("hand", "R0"),
        create("hand", ""),
        create("hand", "nonsense"),
        spaceless,
        so3("hand"),
        create("foot", "sum(R2, SO2[1]:0.5)"),
        list(1, ""),
        list(2, "61726d"),
        list(0, "no token"),
        insert(&[50], "first", 3),
        insert(&[50], "first", 3),
        insert(&[51], "first", 3),
        insert(&[50], "", 4),
        insert(&[1 << 63], "", 0),
        insert(&[], "", 65_537),
        insert(&[], &"ä".repeat(33), 0),
    ];
    ops.extend(sessions::by_hand());
    // These come after the random ones.
    ops.extend([
        insert(&[(1 << 63) - 1], "", 0),
        insert(&[], "", 0),
        info("arm"),
        list(0, ""),
        delete("arm", "another"),
        delete("hand", ""),
        delete("arm", UID),
        delete("arm", UID),
    ]);
    ops
}
