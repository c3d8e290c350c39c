//! Phases of the filter. Each update gives [`Evidence`], which changes the phase; the first row that applies counts:
//!
//! ```text
//! from       condition                                       to         reason
//! Searching  agreement too low                               Lost       none of the particles is right
//! Searching  confirmed and precise                           Tracking   the pose is found
//! Searching  confirmed                                       Uncertain  the place is found, as in a tunnel
//! Searching  no decision within `patience` updates           Lost       no pose is found
//! Tracking   agreement too low, or particles scattered       Lost       the scan does not fit, or nothing holds the pose
//! Tracking   not precise                                     Uncertain  the pose is followed by the odometry
//! Uncertain  agreement too low, or particles scattered       Lost       as while tracking
//! Uncertain  twice as precise, agreement nearly as usual     Tracking   the pose is confirmed again
//! Lost       confirmed and precise, agreement high enough    Tracking   the alarm was false
//! Lost       confirmed, agreement high enough                Uncertain  the alarm was false
//! Lost       panoramas resemble the scan                     Searching  restart, within the same frame
//! ```
//!
//! Twice as precise, since in a tunnel the standard deviation of the position crosses its limit again and again by the noise of
//! the walls. A scan that determines the position reduces it to centimetres at once.
//!
//! A pose counts as not precise, so that the next scan has to confirm it, where the scan refutes the prediction, or the pose that the
//! search found, unless others around the prediction were compared and fit worse; and where others fit as well.
//!
//! Thresholds: [`tracking_loss`](crate::localization::tracking_loss), [`convergence`](crate::localization::convergence),
//! and for what is searched [`places`](crate::localization::places).
//! Without panoramas the filter stays `Lost` until a pose is confirmed. What is reported, see [`Phase::reported`]:
//!
//! ```text
//! Searching  searching          Tracking  tracking; searching while the position is not precise, nothing is compared, much less
//!                                         than usual agrees, or other poses fitted alike in the scan before
//! Uncertain  searching          Lost      lost
//! ```

use crate::localization::particles::{ParticleSet, spread};
use crate::localization::places::PlacesConfig;
use crate::localization::tracking_loss::State;

/// What the filter does with a scan.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Phase {
    /// The particles are where the car may be.
    Searching {
        search: Search,
        /// Updates without a decision.
        updates: usize,
    },
    /// The pose is followed.
    Tracking,
    /// The pose is followed, and was not confirmed since the position was last imprecise.
    Uncertain,
    /// The pose is wrong.
    Lost { search: Search },
}

/// What the particles represent until the filter tracks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Search {
    /// The surroundings of one pose.
    Around,
    /// Many places, none of them registered yet.
    Anywhere,
    /// Places with their weights.
    Places {
        /// Number of places that are likely.
        likely: usize,
    },
}

/// What an update shows.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Evidence {
    /// The averages of the agreement are too low.
    pub disagrees: bool,
    /// The spread of the particles exceeds `max_spread_m`.
    pub is_scattered: bool,
    /// Enough updates in a row agree with the pose to which the particles have converged.
    pub is_confirmed: bool,
    /// Several places agree with the scan: driving decides.
    pub are_alike: bool,
    /// The standard deviation of the position is at most `sure_spread_m`.
    pub is_precise: bool,
    /// The standard deviation of the position is at most half of `sure_spread_m`.
    pub is_twice_as_precise: bool,
    /// The agreement is nearly as large as usual here, see `AgreementMonitor::is_usual`.
    pub is_usual: bool,
}

impl Evidence {
    /// The same for a pose that the next scan has to confirm: how wide the distribution is says nothing.
    pub fn refuted(self) -> Self {
        Self {
            is_precise: false,
            is_twice_as_precise: false,
            ..self
        }
    }
}

impl Search {
    /// The search of particles around a given pose.
    pub fn from_particles(particles: &ParticleSet, config: &PlacesConfig) -> Self {
        if spread(&particles.covariance_about(&particles.mean())).0 > config.known_start_m {
            Self::Anywhere
        } else {
            Self::Around
        }
    }
}

impl Phase {
    /// A search that begins.
    pub fn searching(search: Search) -> Self {
        Self::Searching { search, updates: 0 }
    }

    /// The phase after an update: the table in the head of this module.
    pub fn after(self, update: &Evidence, patience: usize) -> Self {
        let tracked = if update.is_precise {
            Self::Tracking
        } else {
            Self::Uncertain
        };
        match self {
            Self::Searching { search, .. } | Self::Lost { search } if update.disagrees => {
                Self::Lost { search }
            }
            Self::Tracking | Self::Uncertain if update.disagrees || update.is_scattered => {
                Self::Lost {
                    search: Search::Around,
                }
            }
            Self::Searching { .. } | Self::Lost { .. } if update.is_confirmed => tracked,
            Self::Searching { search, updates } if updates >= patience => Self::Lost { search },
            Self::Searching { search, updates } => Self::Searching {
                search,
                updates: if update.are_alike { 0 } else { updates + 1 },
            },
            Self::Tracking => tracked,
            Self::Uncertain if update.is_usual && update.is_twice_as_precise => Self::Tracking,
            Self::Uncertain | Self::Lost { .. } => self,
        }
    }

    /// The state of a frame; `is_sure`: its position is precise, which the odometry changes between updates, its scan was
    /// compared with the map, their agreement is not doubtful, and no others fitted alike in the scan before.
    pub fn reported(self, is_sure: bool) -> State {
        match self {
            Self::Tracking if is_sure => State::Tracking,
            Self::Searching { .. } | Self::Tracking | Self::Uncertain => State::Searching,
            Self::Lost { .. } => State::Lost,
        }
    }

    /// Whether one pose is followed.
    pub fn is_tracking(self) -> bool {
        matches!(self, Self::Tracking | Self::Uncertain)
    }

    /// Whether a pose is searched and the last scan confirmed none.
    pub fn is_unconfirmed(self) -> bool {
        match self {
            Self::Searching { updates, .. } => updates > 0,
            Self::Lost { .. } => true,
            Self::Tracking | Self::Uncertain => false,
        }
    }

    /// What the particles represent; `None` while one pose is followed.
    pub fn search(self) -> Option<Search> {
        match self {
            Self::Searching { search, .. } | Self::Lost { search } => Some(search),
            Self::Tracking | Self::Uncertain => None,
        }
    }

    /// Sets what the particles represent.
    pub fn set_search(&mut self, found: Search) {
        if let Self::Searching { search, .. } | Self::Lost { search } = self {
            *search = found;
        }
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use nalgebra::Vector2;

    use super::*;
    use crate::geometry::Pose2;

    const PATIENCE: usize = 3;

    fn phases() -> Vec<Phase> {
        let search = Search::Places { likely: 2 };
        let searching = |updates| Phase::Searching { search, updates };
        vec![
            searching(0),
            searching(PATIENCE),
            Phase::Tracking,
            Phase::Uncertain,
            Phase::Lost { search },
        ]
    }

    fn evidence() -> impl Iterator<Item = Evidence> {
        (0..128_u32).map(|bits| {
            let bit = |number: u32| bits >> number & 1 == 1;
            Evidence {
                disagrees: bit(0),
                is_scattered: bit(1),
                is_confirmed: bit(2),
                are_alike: bit(3),
                is_precise: bit(4),
                is_twice_as_precise: bit(5),
                is_usual: bit(6),
            }
        })
    }

    fn name(phase: Phase) -> &'static str {
        match phase {
            Phase::Searching { .. } => "Searching",
            Phase::Tracking => "Tracking",
            Phase::Uncertain => "Uncertain",
            Phase::Lost { .. } => "Lost",
        }
    }

    /// Columns of the lines of the head of this file after a line, up to the end of the block.
    fn table(after: &str) -> Vec<Vec<&'static str>> {
        let lines = include_str!("phase.rs").lines();
        let rows = lines.skip_while(|line| !line.contains(after)).skip(1);
        rows.take_while(|line| !line.contains("```"))
            .map(|line| {
                let cells = line.trim_start_matches("//! ").split("  ");
                cells
                    .map(str::trim)
                    .filter(|cell| !cell.is_empty())
                    .collect()
            })
            .collect()
    }

    #[test]
    fn a_start_is_one_place_up_to_the_configured_spread() {
        let poses = [-6.0, 6.0].map(|x| Pose2::new(Vector2::new(x, 0.0), 0.0));
        let particles = ParticleSet::uniform(poses);
        let search = |known_start_m| {
            let config = PlacesConfig {
                known_start_m,
                ..PlacesConfig::default()
            };
            Search::from_particles(&particles, &config)
        };
        assert_eq!(search(10.0), Search::Around);
        assert_eq!(search(5.0), Search::Anywhere);
    }

    #[test]
    fn every_row_of_the_table_is_reached_and_no_other_transition_exists() {
        let mut found = BTreeSet::from([("Lost", "Searching")]);
        for phase in phases() {
            for update in evidence() {
                let after = phase.after(&update, PATIENCE);
                found.insert((name(phase), name(after)));
            }
        }
        found.retain(|(from, to)| from != to);
        let rows = table("//! from  ");
        assert!(rows.iter().all(|row| row.len() == 4), "{rows:?}");
        let listed: BTreeSet<_> = rows.iter().map(|row| (row[0], row[2])).collect();
        assert_eq!(found, listed);
    }

    #[test]
    fn low_agreement_precedes_all_else_and_scattered_particles_matter_only_while_tracking() {
        for phase in phases() {
            for update in evidence() {
                let after = phase.after(&update, PATIENCE);
                let is_lost = update.disagrees || update.is_scattered && phase.is_tracking();
                let stays = matches!(phase, Phase::Lost { .. });
                let is_stuck = matches!(
                    phase,
                    Phase::Searching {
                        updates: PATIENCE,
                        ..
                    }
                );
                if is_lost {
                    assert_eq!(after.reported(true), State::Lost);
                } else if update.is_confirmed || phase.is_tracking() {
                    assert!(after.is_tracking());
                } else {
                    assert_eq!(name(after) == "Lost", stays || is_stuck);
                }
            }
        }
    }

    #[test]
    fn the_search_is_kept_until_a_pose_is_found() {
        for phase in phases().into_iter().filter(|phase| !phase.is_tracking()) {
            for update in evidence() {
                let after = phase.after(&update, PATIENCE);
                assert!(after.is_tracking() || after.search() == phase.search());
            }
        }
    }

    #[test]
    fn places_that_are_alike_use_up_no_patience() {
        let mut phase = phases()[0];
        let alike = Evidence {
            are_alike: true,
            ..Evidence::default()
        };
        for _ in 0..9 {
            phase = phase.after(&alike, PATIENCE);
        }
        assert_eq!(phase, phases()[0]);
        for _ in 0..=PATIENCE {
            assert_eq!(phase.reported(true), State::Searching);
            phase = phase.after(&Evidence::default(), PATIENCE);
        }
        assert_eq!(phase.reported(true), State::Lost);
    }

    #[test]
    fn an_uncertain_pose_is_tracked_again_only_if_twice_as_precise_and_in_usual_agreement() {
        for update in evidence() {
            let after = Phase::Uncertain.after(&update, PATIENCE);
            let is_lost = update.disagrees || update.is_scattered;
            let is_tracked = !is_lost && update.is_twice_as_precise && update.is_usual;
            assert_eq!(after == Phase::Tracking, is_tracked);
        }
    }

    #[test]
    fn only_a_pose_that_is_tracked_and_precise_is_reported_as_tracking() {
        for phase in phases() {
            for is_precise in [false, true] {
                let is_tracked = phase == Phase::Tracking && is_precise;
                let state = phase.reported(is_precise);
                assert_eq!(state == State::Tracking, is_tracked);
                assert_eq!(state == State::Lost, name(phase) == "Lost");
            }
        }
    }
}
