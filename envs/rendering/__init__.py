"""Pictures of the robots: one stage for all of them, frames without a display, video files and contact sheets."""
