//! Arguments of a node of ROS 2.

use std::net::{IpAddr, Ipv4Addr, UdpSocket};

use anyhow::{Result, bail, ensure};
use clap::{Args, ValueEnum};

/// Topics that every node names alike.
pub const TRANSFORMS: &str = "/tf";
pub const STATIC_TRANSFORMS: &str = "/tf_static";
pub const PROPOSALS: &str = "/initialpose";
pub const DIAGNOSTICS: &str = "/diagnostics";

/// Topics that are named after the node.
pub const POSE: &str = "pose";
pub const ODOMETRY: &str = "odometry";
pub const MAP: &str = "map";

/// Topics, frames and networks of ROS 2.
#[derive(Clone, Debug, Args)]
pub struct Ros2Args {
    /// Topic of ROS 2 whose clouds are localized (sensor_msgs/PointCloud2), as a node without ROS; --odometry may be a topic, too.
    #[arg(long = "ros2", value_name = "TOPIC", group = "source", value_parser = topic)]
    pub topic: Option<String>,

    /// Domain of ROS 2; by default ROS_DOMAIN_ID, else 0.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(0..=232))]
    pub domain: Option<u16>,

    /// IPv4 address of this machine in the network of ROS 2; by default all, or what ROS_AUTOMATIC_DISCOVERY_RANGE and ROS_LOCALHOST_ONLY allow.
    #[arg(long, value_name = "IP", value_parser = interface)]
    pub interface: Option<Ipv4Addr>,

    /// Name of the node, before its own topics such as /fpmcl/pose, and in its diagnostics; another one for each robot of a domain.
    #[arg(long, value_name = "NAME", default_value = "fpmcl", value_parser = node_name)]
    pub node_name: String,

    /// Whether clouds that are lost are sent again.
    #[arg(long, value_enum, default_value_t = Reliability::BestEffort)]
    pub reliability: Reliability,

    /// Show the node in `ros2 node list` of Iron and later; nodes of Humble in the same domain misread this message, and may crash.
    #[arg(long)]
    pub node_info: bool,

    /// Frame of the map in ROS 2.
    #[arg(long, value_name = "FRAME", default_value = "map")]
    pub map_frame: String,

    /// Frame of the robot in ROS 2; poses are those of the lidar where no static transform joins the two.
    #[arg(long, value_name = "FRAME", default_value = "base_link")]
    pub base_frame: String,

    /// Time after a scan for which its transform is sent, extrapolated by the motion, for consumers that ask for the present [s].
    #[arg(long, value_name = "SECONDS", default_value_t = 0.0, value_parser = tolerance)]
    pub transform_tolerance: f64,

    /// Another name of a topic of ROS 2; repeatable.
    #[arg(long, value_name = "FROM:=TO", value_parser = remapping)]
    pub remap: Vec<(String, String)>,
}

/// Delivery of the clouds, with the names of ROS 2.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
#[value(rename_all = "snake_case")]
pub enum Reliability {
    /// Lost clouds are sent again; only a sender that is reliable, too, is heard.
    Reliable,
    /// Lost clouds are not sent again, so that a late one delays no other.
    BestEffort,
}

impl Ros2Args {
    /// The name of a topic of the node, before remapping.
    pub fn own_topic(&self, name: &str) -> String {
        format!("/{}/{name}", self.node_name)
    }

    /// Requires that each topic that is remapped is one of those that are used, with that of odometry.
    pub fn check_remappings(&self, odometry: Option<&str>) -> Result<()> {
        let own = [POSE, ODOMETRY, MAP].map(|name| self.own_topic(name));
        let given = self.topic.as_deref().into_iter().chain(odometry);
        let common = [TRANSFORMS, STATIC_TRANSFORMS, PROPOSALS, DIAGNOSTICS];
        let own = own.iter().map(String::as_str);
        let known: Vec<&str> = given.chain(common).chain(own).collect();
        let unknown = |(from, _): &&(String, String)| !known.contains(&from.as_str());
        if let Some((from, to)) = self.remap.iter().find(unknown) {
            bail!(
                "--remap {from}:={to}, but no topic {from} is used; give one of {}",
                known.join(", ")
            );
        }
        Ok(())
    }

    /// Requires that the interface is one of this machine: DDS ignores any other address silently.
    pub fn check_interface(&self) -> Result<()> {
        if let Some(address) = self.interface {
            // Of the loopback only its first address is that of an interface.
            let is_of_interface = !address.is_loopback() || address == Ipv4Addr::LOCALHOST;
            ensure!(
                is_of_interface && UdpSocket::bind((address, 0)).is_ok(),
                "--interface is {address}, but no network interface of this machine has this address; give one of those that `ip -4 address` prints"
            );
        }
        Ok(())
    }

    /// The name of a topic after remapping.
    pub fn remapped<'a>(&'a self, topic: &'a str) -> &'a str {
        let found = self.remap.iter().find(|(from, _)| from == topic);
        found.map_or(topic, |(_, to)| to)
    }

    /// The domain, of the flag or of the variable of ROS 2.
    pub fn domain(&self, variable: Option<&str>) -> Result<u16> {
        match (self.domain, variable.map(str::trim)) {
            (Some(domain), _) => Ok(domain),
            (None, None | Some("")) => Ok(0),
            (None, Some(text)) => {
                let domain = text.parse::<u16>().ok().filter(|it| *it <= 232);
                domain.ok_or_else(|| {
                    anyhow::anyhow!("ROS_DOMAIN_ID is {text}; set a number from 0 to 232")
                })
            }
        }
    }

    /// Addresses of the networks that are used, of the flag or of ROS_AUTOMATIC_DISCOVERY_RANGE and ROS_LOCALHOST_ONLY; `None`:
    /// all.
    pub fn networks(
        &self,
        range: Option<&str>,
        is_local_only: Option<&str>,
    ) -> Result<Option<Vec<IpAddr>>> {
        ensure!(
            self.interface.is_some() || range != Some("OFF"),
            "ROS_AUTOMATIC_DISCOVERY_RANGE is OFF, so that no topic is found; set it to LOCALHOST or SUBNET, or give --interface IP"
        );
        Ok(match self.interface {
            Some(interface) => Some(vec![interface.into()]),
            None if range == Some("LOCALHOST") || is_local_only == Some("1") => {
                Some(vec![Ipv4Addr::LOCALHOST.into()])
            }
            None => None,
        })
    }
}

/// Parses the name of a topic.
pub(super) fn topic(text: &str) -> Result<String, &'static str> {
    let is_name = |part: &str| {
        let is_digit = part.starts_with(|c: char| c.is_ascii_digit());
        let is_part = |c: char| c.is_ascii_alphanumeric() || c == '_';
        !part.is_empty() && !is_digit && part.chars().all(is_part)
    };
    let absolute = text.strip_prefix('/').unwrap_or(text);
    if absolute.split('/').all(is_name) {
        Ok(format!("/{absolute}"))
    } else {
        Err("give the name of a topic, such as /points")
    }
}

fn interface(text: &str) -> Result<Ipv4Addr, &'static str> {
    let address = text.parse::<Ipv4Addr>().ok();
    let is_unicast =
        |it: &Ipv4Addr| !(it.is_unspecified() || it.is_multicast() || it.is_broadcast());
    (address.filter(is_unicast)).ok_or("give an IPv4 address of this machine, such as 192.168.1.5")
}

fn node_name(text: &str) -> Result<String, &'static str> {
    match topic(text) {
        Ok(name) if name[1..] == *text && !text.contains('/') => Ok(text.to_owned()),
        _ => Err("give the name of a node, such as fpmcl_front"),
    }
}

fn tolerance(text: &str) -> Result<f64, &'static str> {
    match text.parse::<f64>() {
        Ok(number) if (0.0..=10.0).contains(&number) => Ok(number),
        _ => Err("give seconds from 0 to 10, such as 0.2"),
    }
}

fn remapping(text: &str) -> Result<(String, String), &'static str> {
    let help = "give two topics, such as /fpmcl/pose:=/pose";
    let (from, to) = text.split_once(":=").ok_or(help)?;
    Ok((topic(from).or(Err(help))?, topic(to).or(Err(help))?))
}

#[cfg(test)]
mod tests {
    use clap::Parser as _;

    use super::*;

    #[derive(clap::Parser)]
    #[command(group = clap::ArgGroup::new("source"))]
    struct Arguments {
        #[command(flatten)]
        ros2: Ros2Args,
    }

    fn parsed(words: &[&str]) -> Result<Ros2Args, clap::Error> {
        let words = ["live"].iter().chain(words);
        Ok(Arguments::try_parse_from(words)?.ros2)
    }

    fn arguments(words: &[&str]) -> Ros2Args {
        parsed(words).unwrap()
    }

    #[test]
    fn flags_take_precedence_over_the_variables_of_ros() {
        let (given, none) = (arguments(&["--domain=7"]), arguments(&[]));
        assert_eq!(given.domain(Some("3")).unwrap(), 7);
        assert_eq!(none.domain(Some("3")).unwrap(), 3);
        assert_eq!(none.domain(None).unwrap(), 0);
        for wrong in ["here", "233", "-1"] {
            let error = none.domain(Some(wrong)).unwrap_err().to_string();
            assert!(error.contains(wrong), "{error}");
        }
        let local = IpAddr::from([127, 0, 0, 1]);
        assert_eq!(none.networks(None, None).unwrap(), None);
        assert_eq!(none.networks(Some("SUBNET"), Some("0")).unwrap(), None);
        for (range, local_only) in [(Some("LOCALHOST"), None), (None, Some("1"))] {
            let networks = none.networks(range, local_only).unwrap();
            assert_eq!(networks, Some(vec![local]));
        }
        assert!(none.networks(Some("OFF"), None).is_err());
        let given = arguments(&["--interface=10.0.0.7"]);
        let networks = given.networks(Some("OFF"), Some("1")).unwrap();
        assert_eq!(networks, Some(vec![IpAddr::from([10, 0, 0, 7])]));
    }

    #[test]
    fn names_of_topics_are_absolute_and_may_be_replaced() {
        let ros2 = arguments(&["--ros2=points", "--remap=fpmcl/pose:=/pose"]);
        assert_eq!(ros2.topic.as_deref(), Some("/points"));
        assert_eq!(ros2.remapped("/fpmcl/pose"), "/pose");
        assert_eq!(ros2.remapped("/fpmcl/map"), "/fpmcl/map");
        for wrong in ["", "/", "/a//b", "/1", "/a b", "/é"] {
            assert!(topic(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn a_topic_that_is_remapped_is_one_that_is_used() {
        let remapping = |from: &str, more: &[&str]| {
            let remap = format!("--remap={from}:=/other");
            let words: Vec<&str> = ["--ros2=/points", &remap]
                .iter()
                .chain(more)
                .copied()
                .collect();
            arguments(&words).check_remappings(Some("/odom"))
        };
        for known in [
            "/points",
            "/odom",
            "/tf",
            "/tf_static",
            "/initialpose",
            "/diagnostics",
        ] {
            remapping(known, &[]).unwrap();
        }
        for own in ["pose", "odometry", "map"] {
            remapping(&format!("/fpmcl/{own}"), &[]).unwrap();
            remapping(&format!("/front/{own}"), &["--node-name=front"]).unwrap();
        }
        for (unknown, more) in [
            ("/fpmcl/poses", &[][..]),
            ("/fpmcl/pose", &["--node-name=front"][..]),
        ] {
            let error = remapping(unknown, more).unwrap_err().to_string();
            assert!(
                error.contains(unknown) && error.contains("/tf_static"),
                "{error}"
            );
        }
    }

    #[test]
    fn a_node_has_one_name_and_the_delivery_of_clouds_those_of_ros() {
        assert_eq!(
            arguments(&["--node-name=front_2"]).own_topic("pose"),
            "/front_2/pose"
        );
        for wrong in [
            "--node-name=a/b",
            "--node-name=/a",
            "--node-name=",
            "--reliability=best-effort",
        ] {
            assert!(parsed(&[wrong]).is_err(), "{wrong}");
        }
        assert_eq!(arguments(&[]).reliability, Reliability::BestEffort);
        let asked = arguments(&["--reliability=reliable"]);
        assert_eq!(asked.reliability, Reliability::Reliable);
    }

    #[test]
    fn an_interface_is_an_address_of_this_machine() {
        arguments(&[]).check_interface().unwrap();
        arguments(&["--interface=127.0.0.1"])
            .check_interface()
            .unwrap();
        // The first is for documentation (RFC 5737).
        for elsewhere in ["192.0.2.1", "127.0.0.2"] {
            let given = arguments(&[&format!("--interface={elsewhere}")]);
            let error = given.check_interface().unwrap_err().to_string();
            assert!(error.contains(elsewhere), "{error}");
        }
        for wrong in ["::1", "0.0.0.0", "239.255.0.1", "eth0"] {
            assert!(
                parsed(&[&format!("--interface={wrong}")]).is_err(),
                "{wrong}"
            );
        }
    }
}
