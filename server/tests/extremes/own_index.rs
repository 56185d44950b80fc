//! An index of its own for each variant of a request that changes it.

use prost_reflect::{DynamicMessage, ReflectMessage};
use wayfold_server::service::Service;

use crate::{
    extremes::{requests, variants},
    quiet::two_points,
};

/// A fresh index, and variant `at` of `request` for it, if the request is one whose earlier variants would decide how the
/// next is refused.
pub(crate) async fn own_index(
    request: &DynamicMessage,
    at: usize,
) -> Option<(Service, DynamicMessage)> {
    let name = request.descriptor();
    if !["OpenSessionRequest", "WriteRequest"].contains(&name.name()) {
        return None;
    }
    let (service, uid) = two_points().await;
    let mut good = requests(&uid).into_iter();
    let good = good.find(|good| good.descriptor() == name)?;
    Some((service, variants(&good).swap_remove(at).1))
}
