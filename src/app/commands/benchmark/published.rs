//! Figures that others have published about public sequences.

use schemars::JsonSchema;
use serde::Serialize;

/// A published figure.
#[derive(Clone, Copy, Debug, Serialize, JsonSchema)]
pub struct Published {
    /// The method.
    pub method: &'static str,
    /// The sequences.
    pub data: &'static str,
    /// The figure, with its unit.
    pub figure: &'static str,
    /// What it is of.
    pub quantity: &'static str,
    /// Where it was published.
    pub source: &'static str,
}

/// Figures of peers. Ours have other definitions where the texts below differ: these are for orientation.
pub const PUBLISHED: [Published; 5] = [
    Published {
        method: "GroundLoc",
        data: "SemanticKITTI 00",
        figure: "0.134 m",
        quantity: "localization in a map, average trajectory error",
        source: "Steinke and Goehring, GroundLoc (RA-L 2025), arXiv 2510.24623",
    },
    Published {
        method: "GroundLoc",
        data: "HeLiPR Roundabout03, across sessions",
        figure: "0.419 m",
        quantity: "localization in the map of another session, average trajectory error",
        source: "Steinke and Goehring, GroundLoc (RA-L 2025), arXiv 2510.24623",
    },
    Published {
        method: "range-mcl",
        data: "KITTI 07",
        figure: "0.38 m",
        quantity: "localization in a mesh map, RMSE of the position, by its own evaluation script",
        source: "Chen et al., Range Image-based LiDAR Localization (ICRA 2021)",
    },
    Published {
        method: "KISS-ICP",
        data: "KITTI 11 to 21",
        figure: "0.61 %",
        quantity: "odometry, translation over segments of 100 to 800 m; as its authors give it, not measured again",
        source: "Vizzo et al., KISS-ICP (RA-L 2023), and KITTI's table of results",
    },
    Published {
        method: "KISS-SLAM",
        data: "-",
        figure: "none",
        quantity: "it makes maps and closes loops; it does not localize in a map, and none of its figures is taken here",
        source: "Guadagnino et al., KISS-SLAM (2025), arXiv 2503.12660",
    },
];
