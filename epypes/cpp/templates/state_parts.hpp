// @STATE
/// What a run leaves for the next one.
struct State {
@STATE_MEMBERS@
    /// Calls visit(name, member) for each value.
    template <class Self, class Visit>
    static void each(Self& self, Visit&& visit) {
@EACH_STATE@
    }
};
// @STATE_OWNED
// A state outlives the inputs of its run, whose memory the caller may use again.
template <class T>
T owned(const T& value) {
    return value;
}

inline cv::Mat owned(const cv::Mat& image) { return image.empty() ? image : image.clone(); }

template <class T>
std::vector<T> owned(const std::vector<T>& items) {
    std::vector<T> result;
    for (const T& item : items) {
        result.push_back(owned(item));
    }
    return result;
}

template <class T>
std::optional<T> owned(const std::optional<T>& value) {
    return value ? std::optional<T>(owned(*value)) : std::nullopt;
}
// @STATE_METHODS
    /// What the next run begins with. A run that throws leaves it as it was.
    const State& state() const { return state_; }

    void set_state(const State& state) { state_ = state; }
// @STATE_MEMBER
    State state_;
// @STATE_TEST
    @NS@::State state;
    @NS@::State::each(state, [&](const char* name, auto& member) { values::read_value(sample[name], member); });
    graph.set_state(state);
// @END
