//! The number and the distance of neighbours: three requests ask for them in the same words, each in a `oneof` of its own.
//! [`NeighborSpec`](crate::v1::NeighborSpec)'s stand for all of them.

use crate::v1::{knn_request, neighbor_spec, query_request};

impl From<knn_request::Count> for neighbor_spec::Count {
    fn from(count: knn_request::Count) -> Self {
        match count {
            knn_request::Count::K(k) => Self::K(k),
            knn_request::Count::KFactor(factor) => Self::KFactor(factor),
        }
    }
}

impl From<neighbor_spec::Count> for knn_request::Count {
    fn from(count: neighbor_spec::Count) -> Self {
        match count {
            neighbor_spec::Count::K(k) => Self::K(k),
            neighbor_spec::Count::KFactor(factor) => Self::KFactor(factor),
        }
    }
}

macro_rules! same_reach {
    ($($request:ident),*) => {
        $(impl From<$request::Reach> for neighbor_spec::Reach {
            fn from(reach: $request::Reach) -> Self {
                match reach {
                    $request::Reach::Radius(radius) => Self::Radius(radius),
                    $request::Reach::ScaledRadius(scaled) => Self::ScaledRadius(scaled),
                }
            }
        }

        impl From<neighbor_spec::Reach> for $request::Reach {
            fn from(reach: neighbor_spec::Reach) -> Self {
                match reach {
                    neighbor_spec::Reach::Radius(radius) => Self::Radius(radius),
                    neighbor_spec::Reach::ScaledRadius(scaled) => Self::ScaledRadius(scaled),
                }
            }
        })*
    };
}

same_reach!(knn_request, query_request);
