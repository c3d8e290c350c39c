//! Arguments of `ground`.

use std::path::PathBuf;

use clap::Args;

use crate::app::run::arguments::setting;
use crate::app::run::machine::MachineArgs;

/// Arguments of `ground`.
#[derive(Clone, Debug, Args)]
pub struct GroundArgs {
    /// Scan (.bin, .pcd, .ply, .npy), recording (its folder, the folder of its scans, or a bag), or configuration
    /// (.yml); by default the configuration's scan_folder.
    pub input: Option<PathBuf>,

    /// Explain the decision at the point nearest to X Y Z in the lidar frame [m]; needs one scan.
    #[arg(
        long,
        value_names = ["X", "Y", "Z"],
        num_args = 3,
        allow_negative_numbers = true,
        requires = "input"
    )]
    pub explain: Option<Vec<f32>>,

    /// Compare the methods on simulated slopes, crests, kerbs and drives with exact labels.
    #[arg(long, conflicts_with = "explain")]
    pub simulated: bool,

    /// YAML file; by default config/ground.yml or, without one, built-in values.
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,

    /// Override a key, such as ground_method=pca; repeatable.
    #[arg(long = "set", value_name = "KEY=VALUE", value_parser = setting)]
    pub settings: Vec<(String, String)>,

    /// Replace existing output; sets the key `force`.
    #[arg(long)]
    pub force: bool,

    /// Renderer and threads.
    #[command(flatten)]
    pub machine: MachineArgs,
}
