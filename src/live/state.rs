//! States of a localization that robots and people act on, each with its reason.

use serde::{Deserialize, Serialize};

/// What may be done with the pose.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum LiveState {
    /// There is no estimate yet.
    Starting,
    /// The pose is not known yet: do not use it.
    Searching,
    /// The scans confirm the pose.
    Tracking,
    /// The pose follows from the last confirmed one by the motion: its uncertainty grows.
    Coasting,
    /// The pose is wrong, or was not confirmed for too long: do not use it. The filter searches by itself.
    Lost,
}

impl LiveState {
    /// All states.
    pub const ALL: [Self; 5] = [
        Self::Starting,
        Self::Searching,
        Self::Tracking,
        Self::Coasting,
        Self::Lost,
    ];

    /// Name of the state.
    pub fn word(self) -> &'static str {
        match self {
            Self::Starting => "starting",
            Self::Searching => "searching",
            Self::Tracking => "tracking",
            Self::Coasting => "coasting",
            Self::Lost => "lost",
        }
    }

    /// Whether the pose is believed, and published as a transform.
    pub fn is_believed(self) -> bool {
        matches!(self, Self::Tracking | Self::Coasting)
    }
}

/// Why a localization is in its state; each reason belongs to one state.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum Reason {
    /// No scan has arrived.
    NoScan,
    /// The map is prepared for the first scan.
    Preparing,
    /// The position is not determined well enough.
    PositionUnknown,
    /// Several places agree with the scans.
    SeveralPlaces,
    /// The clock of the scans was set.
    ClockJumped,
    /// A pose was proposed, and no scan has confirmed it.
    PoseProposed,
    /// The scan agrees with the map.
    ScanAgrees,
    /// The scan does not determine the position, as in a tunnel: the motion carries it.
    PositionImprecise,
    /// No scan arrives: the motion carries the pose.
    SensorStalled,
    /// Scans arrive that cannot be used, such as repeated ones: the motion carries the pose.
    ScansUnusable,
    /// The scan does not agree with the map.
    ScanDisagrees,
    /// The particles are scattered: nothing holds the pose.
    ParticlesScattered,
    /// The search found no place that agrees.
    NoPlaceFound,
    /// No scan arrived for too long.
    StalledTooLong,
    /// No scan that can be used arrived for too long.
    UnusableTooLong,
}

impl Reason {
    /// All reasons.
    pub const ALL: [Self; 15] = [
        Self::NoScan,
        Self::Preparing,
        Self::PositionUnknown,
        Self::SeveralPlaces,
        Self::ClockJumped,
        Self::PoseProposed,
        Self::ScanAgrees,
        Self::PositionImprecise,
        Self::SensorStalled,
        Self::ScansUnusable,
        Self::ScanDisagrees,
        Self::ParticlesScattered,
        Self::NoPlaceFound,
        Self::StalledTooLong,
        Self::UnusableTooLong,
    ];

    /// The state to which the reason leads.
    pub fn state(self) -> LiveState {
        match self {
            Self::NoScan | Self::Preparing => LiveState::Starting,
            Self::PositionUnknown
            | Self::SeveralPlaces
            | Self::ClockJumped
            | Self::PoseProposed => LiveState::Searching,
            Self::ScanAgrees => LiveState::Tracking,
            Self::PositionImprecise | Self::SensorStalled | Self::ScansUnusable => {
                LiveState::Coasting
            }
            Self::ScanDisagrees
            | Self::ParticlesScattered
            | Self::NoPlaceFound
            | Self::StalledTooLong
            | Self::UnusableTooLong => LiveState::Lost,
        }
    }

    /// The reason in words, for logs.
    pub fn words(self) -> &'static str {
        match self {
            Self::NoScan => "no scan has arrived",
            Self::Preparing => "the map is prepared for the first scan",
            Self::PositionUnknown => "the position is not known well enough yet",
            Self::SeveralPlaces => "several places agree with the scans",
            Self::ClockJumped => "the clock of the scans was set",
            Self::PoseProposed => "a pose was proposed that no scan has confirmed yet",
            Self::ScanAgrees => "the scan agrees with the map",
            Self::PositionImprecise => {
                "the scan does not determine the position; the motion carries it"
            }
            Self::SensorStalled => "no scan arrives; the motion carries the pose",
            Self::ScansUnusable => {
                "the scans that arrive cannot be used; the motion carries the pose"
            }
            Self::ScanDisagrees => "the scan does not agree with the map",
            Self::ParticlesScattered => "nothing holds the pose: the particles are scattered",
            Self::NoPlaceFound => "no place was found that agrees with the scans",
            Self::StalledTooLong => "no scan arrived for too long",
            Self::UnusableTooLong => "no scan that can be used arrived for too long",
        }
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    #[test]
    fn every_state_has_a_reason_and_every_reason_its_own_words() {
        let states: BTreeSet<LiveState> = Reason::ALL.map(Reason::state).into();
        assert_eq!(states, LiveState::ALL.into());
        let words: BTreeSet<&str> = Reason::ALL.map(Reason::words).into();
        assert_eq!(words.len(), Reason::ALL.len());
    }
}
