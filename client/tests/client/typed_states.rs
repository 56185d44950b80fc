//! States as types of their own.

use std::f64::consts::{FRAC_PI_2, PI};

use nalgebra::{
    DVector, Isometry2, Isometry3, Point3, SVector, Translation3, UnitComplex, UnitQuaternion,
    Vector2, Vector3,
};
use wayfold::{Error, FromState, State};

use crate::server::Server;

#[tokio::test]
async fn poses_in_space_are_sent_and_read_back() {
    let server = Server::start();
    let index = server.index("se3", "R3*SO3:0.15").await;
    // A quarter turn about z is the quaternion (0, 0, sin 45°, cos 45°).
    let turned = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), FRAC_PI_2);
    let pose = Isometry3::from_parts(Translation3::new(1.0, 2.0, 3.0), turned);
    index.insert([pose]).await.unwrap();
    let read = index.get([0]).await.unwrap();
    let half = 0.5_f64.sqrt();
    for (number, expected) in read
        .point(0)
        .state
        .iter()
        .zip([1.0, 2.0, 3.0, 0.0, 0.0, half, half])
    {
        assert!((number - expected).abs() < 1e-15, "{read:?}");
    }
    let back: Isometry3<f64> = read.point(0).state_as().unwrap();
    assert!((back.inverse() * pose).rotation.angle() < 1e-7);
    assert_eq!(back.translation, pose.translation);
    assert_eq!(read.point(0).state_as::<[f64; 6]>(), None);

    // The distance of a quarter turn is half its angle, weighted: sqrt(0.15) · π/4.
    let straight = Isometry3::from_parts(pose.translation, UnitQuaternion::identity());
    let nearest = index.knn([straight]).await.unwrap();
    assert!(
        (nearest.row(0).nearest().unwrap().distance - 0.15_f64.sqrt() * PI / 4.0).abs() < 1e-15
    );
}

#[tokio::test]
async fn a_type_that_does_not_fit_the_space_is_not_sent() {
    let server = Server::start();
    let turned_about = server.index("so3-first", "SO3*R3").await;
    let error = turned_about
        .knn([Isometry3::<f64>::identity()])
        .await
        .unwrap_err();
    let Error::Layout {
        given, expected, ..
    } = &error
    else {
        panic!("{error}")
    };
    assert_eq!(given, "real, real, real, qx, qy, qz, qw");
    assert_eq!(expected, "qx, qy, qz, qw, real, real, real");
    let degrees = server.index("degrees", "R2*SO2[360]").await;
    assert!(matches!(
        degrees.insert([Isometry2::<f64>::identity()]).await,
        Err(Error::Layout { .. })
    ));
    let error = degrees
        .insert([vec![0.0, 0.0, 90.0], vec![0.0; 4]])
        .await
        .unwrap_err();
    assert_eq!(
        error.to_string(),
        "states[1]: 4 numbers, where a state of this space has 3"
    );
    assert_eq!(degrees.info().await.unwrap().revision.number, 0);
}

#[test]
fn every_type_writes_the_row_that_it_reads() {
    fn row(state: impl State) -> Vec<f64> {
        let mut row = Vec::new();
        state.write(&mut row);
        row
    }
    let quaternion = UnitQuaternion::from_euler_angles(0.1, 0.2, 0.3);
    let [x, y, z, w] = [quaternion.i, quaternion.j, quaternion.k, quaternion.w];
    assert_eq!(row(quaternion), [x, y, z, w]);
    assert_eq!(
        row(UnitQuaternion::from_state(&[x, y, z, w]).unwrap()),
        [x, y, z, w]
    );
    assert_eq!(
        row(Isometry2::new(Vector2::new(1.0, 2.0), FRAC_PI_2)),
        [1.0, 2.0, FRAC_PI_2]
    );
    assert_eq!(
        row(Isometry2::from_state(&[1.0, 2.0, FRAC_PI_2]).unwrap()),
        [1.0, 2.0, FRAC_PI_2]
    );
    assert_eq!(
        row(UnitComplex::from_state(&[FRAC_PI_2]).unwrap()),
        [FRAC_PI_2]
    );
    assert_eq!(row(Point3::new(1.0, 2.0, 3.0)), [1.0, 2.0, 3.0]);
    assert_eq!(
        Point3::from_state(&[1.0, 2.0, 3.0]),
        Some(Point3::new(1.0, 2.0, 3.0))
    );
    assert_eq!(row(SVector::<f64, 2>::new(1.0, 2.0)), [1.0, 2.0]);
    assert_eq!(row(DVector::from_state(&[1.0, 2.0]).unwrap()), [1.0, 2.0]);
    assert_eq!(row([1.0, 2.0].as_slice()), [1.0, 2.0]);
    assert_eq!(Vec::from_state(&[1.0]), Some(vec![1.0]));
    assert_eq!(<[f64; 2]>::from_state(&[1.0]), None);
}
