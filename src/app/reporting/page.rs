//! A page: sections of facts, tables, pictures and texts in one file that needs no network.
//!
//! On a phone wide tables scroll inside their own frame; in print everything that is folded away
//! is unfolded.

use super::html::{escaped, picture, table};
use crate::app::comparison::Table;

const STYLE: &str = include_str!("page.css");
const SCRIPT: &str = include_str!("page.js");

/// One HTML file.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Page {
    /// Of the window and above everything.
    pub title: String,
    /// Below it, in a sentence.
    pub subtitle: String,
    /// From the top; the contents are made of their titles.
    pub sections: Vec<Section>,
}

/// A part of a page.
#[derive(Clone, Debug, PartialEq)]
pub struct Section {
    /// Its heading.
    pub title: String,
    /// From the top.
    pub blocks: Vec<Block>,
}

/// What a section is made of.
#[derive(Clone, Debug, PartialEq)]
pub enum Block {
    /// A sentence or more.
    Paragraph(String),
    /// Names with what they are.
    Facts(Vec<(String, String)>),
    /// A table.
    Table(Table),
    /// A picture.
    Picture {
        /// The bytes of the PNG.
        png: Vec<u8>,
        /// What it shows.
        caption: String,
    },
    /// A text as it is, folded away under its name.
    Folded {
        /// Its name.
        name: String,
        /// The text.
        text: String,
    },
}

impl Page {
    /// The file.
    pub fn to_html(&self) -> String {
        let title = escaped(&self.title);
        let contents: String = self
            .sections
            .iter()
            .enumerate()
            .map(|(index, section)| {
                format!(
                    "<a href=\"#section-{index}\">{}</a>\n",
                    escaped(&section.title)
                )
            })
            .collect();
        let sections: String = self
            .sections
            .iter()
            .enumerate()
            .map(|(index, section)| section.to_html(index))
            .collect();
        format!(
            "<!doctype html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n\
             <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n\
             <title>{title}</title>\n<style>\n{STYLE}</style>\n</head>\n<body>\n<main>\n\
             <header><h1>{title}</h1>\n<p>{}</p>\n<nav>{contents}</nav></header>\n\
             {sections}</main>\n<script>\n{SCRIPT}</script>\n</body>\n</html>\n",
            escaped(&self.subtitle)
        )
    }
}

impl Section {
    fn to_html(&self, index: usize) -> String {
        let blocks: String = self.blocks.iter().map(Block::to_html).collect();
        format!(
            "<section id=\"section-{index}\">\n<h2>{}</h2>\n{blocks}</section>\n",
            escaped(&self.title)
        )
    }
}

impl Block {
    fn to_html(&self) -> String {
        match self {
            Self::Paragraph(text) => format!("<p>{}</p>\n", escaped(text)),
            Self::Facts(facts) => {
                let items: String = facts
                    .iter()
                    .map(|(name, value)| {
                        format!("<dt>{}</dt><dd>{}</dd>\n", escaped(name), escaped(value))
                    })
                    .collect();
                format!("<dl class=\"facts\">\n{items}</dl>\n")
            }
            Self::Table(found) => {
                format!("<h3>{}</h3>\n{}", escaped(&found.title), table(found))
            }
            Self::Picture { png, caption } => picture(png, caption),
            Self::Folded { name, text } => format!(
                "<details><summary>{}</summary><pre>{}</pre></details>\n",
                escaped(name),
                escaped(text)
            ),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::markdown::tests::example;
    use super::*;

    fn page() -> Page {
        Page {
            title: "A <run>".to_owned(),
            subtitle: "of a street".to_owned(),
            sections: vec![
                Section {
                    title: "Errors".to_owned(),
                    blocks: vec![
                        Block::Facts(vec![("seed".to_owned(), "1 & 2".to_owned())]),
                        Block::Table(example()),
                    ],
                },
                Section {
                    title: "Pictures".to_owned(),
                    blocks: vec![
                        Block::Picture {
                            png: vec![1, 2, 3],
                            caption: "path".to_owned(),
                        },
                        Block::Folded {
                            name: "log".to_owned(),
                            text: "</pre><script>alert()</script>".to_owned(),
                        },
                    ],
                },
            ],
        }
    }

    #[test]
    fn what_is_opened_is_closed() {
        let html = page().to_html();
        for tag in [
            "html", "head", "body", "main", "section", "table", "tr", "td", "th", "dl", "details",
            "pre", "figure", "script", "style", "nav", "div", "small",
        ] {
            let opened = html.matches(&format!("<{tag}>")).count()
                + html.matches(&format!("<{tag} ")).count();
            let closed = html.matches(&format!("</{tag}>")).count();
            assert_eq!(opened, closed, "{tag}");
            assert!(opened > 0, "{tag}");
        }
    }

    #[test]
    fn nothing_is_loaded_from_anywhere_and_no_text_becomes_a_script() {
        let html = page().to_html();
        for word in ["http://", "https://", "src=\"/", "<link", "@import", "url("] {
            assert!(!html.contains(word), "{word}");
        }
        assert_eq!(html.matches("<script>").count(), 1);
        assert!(html.contains("A &lt;run&gt;"));
    }

    #[test]
    fn every_section_is_in_the_contents() {
        let html = page().to_html();
        for index in 0..2 {
            assert!(html.contains(&format!("href=\"#section-{index}\"")));
            assert!(html.contains(&format!("id=\"section-{index}\"")));
        }
    }
}
