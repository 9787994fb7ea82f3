// @IMAGE_IN
    cv::Mat image = cv::imread(path, @IMREAD_FLAGS@);
    if (!image.empty()) {
        if (@IS_OTHER_IMAGE@) {
            throw std::invalid_argument("@IMAGE@ has to be @IMAGE_TEXT@; " + path + " is read as " +
                                        cv::typeToString(image.type()));
        }
@RGB_IN@        inputs.@IMAGE@ = image;
        return;
    }
// @RGB_IN
        cv::cvtColor(image, image, @RGB_CODE@);  // the graph takes RGB
// @END
