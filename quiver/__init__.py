"""quiver: restores blur-free video from few-bit quanta streams; trains, evaluates and compares."""
