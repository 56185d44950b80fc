//! Conversions between the forms of k and radius: three requests have the same `oneof`s, each as a Rust type of its
//! own. The types of [`NeighborSpec`](crate::v1::NeighborSpec) are the common ones.

use crate::v1::{knn_request, neighbor_spec, query_request};

impl From<knn_request::KForm> for neighbor_spec::KForm {
    fn from(k: knn_request::KForm) -> Self {
        match k {
            knn_request::KForm::K(k) => Self::K(k),
            knn_request::KForm::KFactor(factor) => Self::KFactor(factor),
        }
    }
}

impl From<neighbor_spec::KForm> for knn_request::KForm {
    fn from(k: neighbor_spec::KForm) -> Self {
        match k {
            neighbor_spec::KForm::K(k) => Self::K(k),
            neighbor_spec::KForm::KFactor(factor) => Self::KFactor(factor),
        }
    }
}

macro_rules! same_radius_form {
    ($($request:ident),*) => {
        $(impl From<$request::RadiusForm> for neighbor_spec::RadiusForm {
            fn from(radius: $request::RadiusForm) -> Self {
                match radius {
                    $request::RadiusForm::Radius(radius) => Self::Radius(radius),
                    $request::RadiusForm::ScaledRadius(scaled) => Self::ScaledRadius(scaled),
                }
            }
        }

        impl From<neighbor_spec::RadiusForm> for $request::RadiusForm {
            fn from(radius: neighbor_spec::RadiusForm) -> Self {
                match radius {
                    neighbor_spec::RadiusForm::Radius(radius) => Self::Radius(radius),
                    neighbor_spec::RadiusForm::ScaledRadius(scaled) => Self::ScaledRadius(scaled),
                }
            }
        })*
    };
}

same_radius_form!(knn_request, query_request);
