"""Worker processes as the service sees them: started, fed, watched and asked."""
